"""The smallest sizes that cost no accuracy on given data: one key at a time, by validation scores alone."""

import math
from collections.abc import Iterator, Sequence

import yaml

from gaigs.benchmark import Context, Glance, Row
from gaigs.benchmark._accuracy_page import Place, places
from gaigs.benchmark._page import number, remarks, table
from gaigs.benchmark._scale import Scale, scale_of
from gaigs.benchmark._trainings import Trainings
from gaigs.registry import check_type, register

RATIO = "ratio"
"""What ``tolerance`` calls the unit of scores without one."""

SEED = "seed"
"""The key of axes that tell how much scores scatter by chance."""

INTRODUCTION = """## Budgets

Here you find how small each part may be before accuracy suffers: the smallest value whose mean validation score is
within the tolerance of the best value's. One key changes at a time, all others are as in the reference. Test links have
no say. Where scores scatter over seeds by more than the tolerance, a difference of that size says nothing. Where it is
the largest tried, a larger one may be better still. Times are of one run each; where other work was on the machine,
they tell orders of magnitude alone.
"""


@register("benchmark", "budgets")
class Budgets(Trainings):
    """Trains each value of each axis, and tells the smallest that is good enough.

    Args:
        trainer, minutes, device: As for ``Trainings``.
        axes: Likewise; an axis without values takes those of ``factors``. One with the key ``seed`` tells how much
            scores scatter.
        factors: Of the default.
        tolerance: Below the best validation score, by the score's unit: ``dB``, or ``ratio`` for none.

    Raises:
        TypeError, ValueError: An option does not have its form.
    """

    name = "budgets"

    def __init__(
        self,
        trainer: dict,
        axes: dict,
        factors: list[float],
        tolerance: dict,
        minutes: float | None = None,
        device: str | None = None,
    ):
        super().__init__(trainer, axes, minutes, device)
        check_type("benchmark.tolerance", tolerance, dict[str, float])
        for name, axis in axes.items():
            for value in axis.get("values") or ():
                entries = value if isinstance(value, list) else [value]
                if not entries or not all(type(entry) in (int, float) for entry in entries):
                    raise TypeError(
                        f"benchmark.axes.{name}.values must be sizes, numbers or lists of them, got {value!r}"
                    )
        self.factors, self.tolerance = factors, tolerance

    def cells(self, context: Context) -> Iterator[list[Row]]:
        self._tolerance_of(scale_of(self.reference(context)["task"]["name"]))
        for device in context.devices:
            for cell in self.cells_of_axes(context, device):
                for row in cell:
                    _check_size(row)
                yield cell

    def values_about(self, axis: str, default: object) -> list:
        """Multiples of the default, of a list of each entry; at least 1.

        Raises:
            ValueError: The default is no whole number, and no list of such.
        """
        entries = default if isinstance(default, list) else [default]
        if not all(type(entry) is int for entry in entries):
            return super().values_about(axis, default)
        found = dict.fromkeys(tuple(max(1, round(entry * factor)) for entry in entries) for factor in self.factors)
        return [[*value] if isinstance(default, list) else value[0] for value in found]

    def tables(self, rows: Sequence[Row]) -> str:
        parts = [INTRODUCTION]
        for place, own in places(rows).items():
            scale = scale_of(place.task)
            parts.append(_part(place, own, self._tolerance_of(scale), scale))
        return "\n".join([*parts, remarks(rows, ("key", "value", "of", "scene", "device"))]).rstrip() + "\n"

    def _tolerance_of(self, scale: Scale) -> float:
        unit = scale.unit or RATIO
        if unit not in self.tolerance:
            raise ValueError(
                f"benchmark.tolerance must have the unit {unit!r} of {scale.title}, got {', '.join(self.tolerance)}"
            )
        return self.tolerance[unit]

    def highlights(self, rows: Sequence[Row]) -> Sequence[Glance]:
        return ()  # what is small enough is no error against a time


def _part(place: Place, rows: Sequence[Row], tolerance: float, scale: Scale) -> str:
    references: dict[str, dict[str, list[Row]]] = {}
    for row in rows:
        if row["validation"]:
            references.setdefault(row["of"], {}).setdefault(row["axis"], []).append(row)
    command = " ".join(filter(None, ("python -m gaigs command=benchmark benchmark=budgets", place.overrides)))
    conditions = "; ".join(filter(None, (place.device, place.trainer)))
    parts = [f"### {place.title}\n\n{conditions}\n\n```\n{command}\n```\n"]
    unit = f" {scale.unit}" if scale.unit else ""
    head = ["part", "key", f"{scale.title} of the validation links by value", f"smallest within {tolerance:g}{unit}"]
    head += ["default now", "inference [ms], smallest, default", "training [s], smallest, default"]
    for of, axes in references.items():
        scatter = [_over_seeds(own, tolerance, scale) for own in axes.values() if own[0]["key"] == SEED]
        lines = [_line(name, own, tolerance, scale) for name, own in axes.items() if own[0]["key"] != SEED]
        reference = " ".join([f"Reference: `{of or 'the command line'}`.", *scatter])
        parts.append(f"{reference}\n\n{table(head, lines)}")
    return "\n".join(parts)


def _line(name: str, rows: Sequence[Row], tolerance: float, scale: Scale) -> list[str]:
    """An axis: its values with their scores, and the smallest that is good enough."""
    rows = sorted(rows, key=lambda row: size(row["value"]))
    smallest = smallest_within(rows, tolerance, scale)
    scores = ", ".join(f"{row['value']}: {number(row['validation'])}" for row in rows)
    default = next((row for row in rows if row["value"] == row["default"]), None)
    pair = lambda key: ", ".join(number(row[key]) if row else "not measured" for row in (smallest, default))
    costs = [pair("inference_ms"), pair("train_seconds")]
    told = f"**{smallest['value']}**" + (", the largest tried" if smallest is rows[-1] else "")
    return [name, f"`{rows[0]['key']}`", scores, told, rows[0]["default"], *costs]


def smallest_within(rows: Sequence[Row], tolerance: float, scale: Scale) -> Row:
    """The row of the smallest value whose validation score is no further than the tolerance from the best."""
    sign = -1 if scale.higher_is_better else 1
    losses = [sign * float(row["validation"]) for row in rows]
    # Scores are told with six digits: one at the bound counts.
    within = [row for row, loss in zip(rows, losses, strict=True) if loss <= min(losses) + tolerance * (1 + 1e-9)]
    return min(within, key=lambda row: size(row["value"]))


def size(value: str) -> float:
    """Of a value: its number, or the product of a list's."""
    found = yaml.safe_load(value)
    return float(math.prod(found) if isinstance(found, list) else found)


def _check_size(row: Row) -> None:
    """Sees to it that the default of a row's key is a size.

    Raises:
        ValueError: It is none, so that no value is smaller than it.
    """
    try:
        size(row["default"])
    except (TypeError, ValueError):
        raise ValueError(
            f"benchmark.axes.{row['axis']}.key must be that of a size, a number or a list of them, and {row['key']} is "
            f"{row['default']}; take another key"
        ) from None


def _over_seeds(rows: Sequence[Row], tolerance: float, scale: Scale) -> str:
    scores = [float(row["validation"]) for row in rows]
    spread = max(scores) - min(scores)
    seeds = ", ".join(row["value"] for row in rows)
    told = ", ".join(number(row["validation"]) for row in rows)
    unit = f" {scale.unit}" if scale.unit else ""
    side = "within" if spread <= tolerance else "beyond"
    return f"Seeds {seeds} score {told}: they scatter by {number(str(spread))}{unit}, {side} the tolerance."
