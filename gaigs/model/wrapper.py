"""Models made of other models."""

from abc import abstractmethod
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from gaigs.core.query import Batch, Query
from gaigs.core.scene import Scene
from gaigs.data import Links
from gaigs.model.base import Model
from gaigs.registry import registry
from gaigs.splatting.gaussians import Gaussians


class Wrapper(Model):
    """Base of models that wrap an ``underlying`` model, and show its room and files."""

    @property
    @abstractmethod
    def underlying(self) -> Model:
        """The wrapped model, such as the trend of kriging."""

    @property
    def has_room(self) -> bool:
        """False if the underlying model has no part in predictions; its room is not shown."""
        return True

    @property
    def primitives(self) -> Gaussians | None:  # type: ignore[override]
        return self.underlying.primitives if self.has_room else None

    def rendering(self, batch: Batch) -> Callable[[], object] | None:
        return self.underlying.rendering(batch)

    def learnt_room(self, links: Links | None = None) -> Any:
        return self.underlying.learnt_room(links) if self.has_room else None

    def learnt_paths(self, query: Query) -> list:
        return self.underlying.learnt_paths(query) if self.has_room else []

    def export(self, folder: Path) -> None:
        if self.has_room:
            self.underlying.export(folder)


def build_trend(trend: str | Mapping | Model, scene: Scene) -> Model:
    """Builds the model of a trend; errors name the option ``model.trend``."""
    try:
        return registry("model").build(trend, scene=scene)
    except ValueError as error:
        raise ValueError(f"model.trend: {error}") from error
