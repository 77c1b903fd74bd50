"""RF-3DGS: first the geometry of the Gaussians, then their radio signal."""

from collections.abc import Callable
from pathlib import Path

import torch
from torch import distributed, nn

from gaigs.core.query import Batch
from gaigs.core.scene import Scene
from gaigs.data import Links
from gaigs.model import Prediction
from gaigs.model.gaigs import GaussianSplatting
from gaigs.registry import call
from gaigs.splatting.gaussians import SH_DC
from gaigs_rf_3dgs.geometry import read_geometry

GREY = 0.5
"""Signal of each Gaussian after its harmonics are reset, as of colours in 3-D Gaussian splatting.
"""

GEOMETRY = ("means", "quats", "log_scales")
"""Parameters that the second stage leaves as they are."""


class Rf3dgs(GaussianSplatting):
    """The splatting pipeline, trained in two stages.

    1. Geometry. With a file, Gaussians stand at its points, and nothing is trained. Without a file
       everything is trained, and each Gaussian sends alike for all transmitters: it learns what the
       training spectra have in common.
    2. Radio. Centres, orientations and scales are frozen and the signal is reset. Opacities are
       trained, and spherical harmonics over the direction from which a transmitter sees a Gaussian.

    Args:
        scene: Receivers and task.
        geometry: File with the room's points, mesh or splats, see ``gaigs_rf_3dgs.geometry``; None
            for none.
        first_stage: Share of the training that the first stage takes without a file.
        **options: Options of ``GaussianSplatting``.

    Raises:
        ValueError: The labels are no spectra, or an option is out of range.

    Source: RF-3DGS (arXiv 2411.19420), where the receiver moves and the transmitter stands still.
    """

    name = "rf_3dgs"

    def __init__(self, scene: Scene, geometry: str | None, first_stage: float, **options):
        if scene.task.directions is None:
            raise ValueError(
                f"model 'rf_3dgs' learns from spectra, not labels of task {scene.task.name!r}; use "
                "another model"
            )
        if not 0 < first_stage < 1:
            raise ValueError(f"model.first_stage must lie between 0 and 1, got {first_stage}")
        call(f"model {self.name!r}", super().__init__, options, scene=scene)
        self.geometry = geometry
        self.first_stage = first_stage
        self.degree = self.gaussians.degree
        self.register_buffer("stage", torch.tensor(1))
        self.register_load_state_dict_post_hook(lambda module, _: module._enter())
        self._enter()

    def forward(self, batch: Batch) -> Prediction:
        """Predicts as ``GaussianSplatting``.

        Raises:
            ValueError: Several processes train, which cannot freeze shared parameters.
        """
        if self.training and distributed.is_available() and distributed.is_initialized():
            raise ValueError(
                "model 'rf_3dgs' freezes its geometry within the training, which one process can "
                f"do, not {distributed.get_world_size()}; set trainer.devices=1"
            )
        return super().forward(batch)

    @torch.no_grad()
    def fit(self, links: Links) -> None:
        """Fits as ``GaussianSplatting``, and moves the Gaussians to the points of the file."""
        super().fit(links)
        if self.geometry is None:
            return
        gaussians = self.gaussians
        logit = gaussians.opacity_logits[0].clone()
        geometry = read_geometry(Path(self.geometry), len(gaussians))
        gaussians.resize(len(geometry.means))
        gaussians.opacity_logits.fill_(logit)
        self._reset()
        for name, values in geometry._asdict().items():
            if values is not None:
                getattr(gaussians, name).copy_(values)

    @property
    def revisions(self) -> tuple[float, ...]:
        return (self.first_stage if self.geometry is None else 0.0,)

    def revise(
        self, number: int, train: Batch, validation: Batch | None, loss: Callable[[Batch], float]
    ) -> str:
        """Begins the second stage."""
        self.stage.fill_(2)
        self._enter()
        self._reset()
        return (
            f"geometry of {len(self.gaussians)} Gaussians frozen; harmonics of degree "
            f"{self.degree} from here on"
        )

    def facts(self) -> dict[str, object]:
        """Facts of ``GaussianSplatting``, the stage of the model, and the file of its geometry."""
        source = "training spectra" if self.geometry is None else Path(self.geometry).name
        return super().facts() | {"stage": int(self.stage), "geometry": source}

    def _enter(self) -> None:
        """Sets the degree of the harmonics and the trained parameters, by the stage."""
        is_radio = int(self.stage) == 2
        self.gaussians.degree = self.degree if is_radio else 0
        for name in GEOMETRY:
            getattr(self.gaussians, name).requires_grad_(not is_radio)

    @torch.no_grad()
    def _reset(self) -> None:
        """Sets the signal to ``GREY`` in all directions."""
        nn.init.zeros_(self.gaussians.signal)
        self.gaussians.signal[..., 0] = GREY / SH_DC
