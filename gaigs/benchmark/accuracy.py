"""Seconds of training to reach a score, and what a prediction takes at which error: of all systems, end to end."""

from collections.abc import Iterator, Mapping, Sequence

import yaml

from gaigs.benchmark import Context, Glance, Row, check_names
from gaigs.benchmark._accuracy_page import LOOK_UPS, SYSTEMS, figures, highlights, tables
from gaigs.benchmark._trainings import Trainings, written
from gaigs.configuration import conf_dir, plugin_conf_dirs
from gaigs.registry import check_type, register, registry
from gaigs.report.systems import read_published

OF_TRAINED = "kriging"
"""The model that is made of a trained one alone."""


@register("benchmark", "accuracy")
class Accuracy(Trainings):
    """Trains every system for the same time, and the values of some axes; look-ups stand beside them.

    Args:
        trainer, axes, minutes, device: As for ``Trainings``.
        levels: Validation scores, by the score's name, of which the time to reach them is told; those that the look-ups
            reach are told anyway.
        systems: Models; None: all that are installed but those that some task names as a baseline.

    Raises:
        TypeError, ValueError: An option does not have its form.
    """

    name = "accuracy"

    def __init__(
        self,
        trainer: dict,
        axes: dict,
        levels: dict,
        systems: list[str] | None = None,
        minutes: float | None = None,
        device: str | None = None,
    ):
        super().__init__(trainer, axes, minutes, device)
        for score, found in levels.items():
            check_type(f"benchmark.levels.{score}", found, list[float])
        if systems:
            check_names("systems", systems, registry("model").names())
        self.levels, self.systems = levels, systems

    def cells(self, context: Context) -> Iterator[list[Row]]:
        look_ups = self.reference(context)["baselines"]
        systems = installed() if self.systems is None else self.systems
        for device in context.devices:
            for config in look_ups:
                options = [f"++model.{key}={written(value)}" for key, value in config.items() if key != "name"]
                yield self.cell(context, device, options, axis=LOOK_UPS, key="model", value=config["name"])
            for name in systems:
                yield self.cell(context, device, (), axis=SYSTEMS, key="model", value=name)
            yield from self.cells_of_axes(context, device)

    def tables(self, rows: Sequence[Row]) -> str:
        return tables(rows, self.levels)

    def figures(self, rows: Sequence[Row]) -> Mapping:
        return figures(rows)

    def highlights(self, rows: Sequence[Row]) -> Sequence[Glance]:
        return highlights(rows)


def installed() -> list[str]:
    """Models that may need a training, those that publications name first and in their order.

    What some task names as a baseline has none.
    """
    without = {OF_TRAINED}
    for folder in (conf_dir(), *plugin_conf_dirs()):
        for file in sorted(folder.glob("task/*.yaml")):
            without |= {config["name"] for config in yaml.safe_load(file.read_text())["task"].get("baselines", ())}
    names, order = set(registry("model").names()) - without, [*read_published().names]
    return sorted(names, key=lambda name: (order.index(name) if name in order else len(order), name))
