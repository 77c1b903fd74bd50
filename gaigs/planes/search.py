"""Planes moved by the phases of waves, and planes and paths to drop."""

import logging
from collections.abc import Callable

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from gaigs.core.geometry import FAINTEST, Grid
from gaigs.core.query import Batch
from gaigs.core.stages import track
from gaigs.planes.channel_search import log_share
from gaigs.planes.lag_search import WIDEST
from gaigs.splatting.placement.mirrored.paths import Mirrored
from gaigs.splatting.placement.mirrored.reflections import square_normals

log = logging.getLogger(__name__)

NEGLIGIBLE = 1e-6
"""Power of a path over the strongest one's below which it is dropped in any case: hundreds would
take long.
"""

Loss = Callable[[Batch], float]
"""Loss of the model as it stands, on a batch."""


def thinned(batch: Batch, rows: int) -> Batch:
    """A batch with about ``rows`` of its labels' rows, and columns in proportion."""
    labels, directions = batch.labels, batch.directions
    if isinstance(directions, Grid):
        every = slice(None, None, max(1, round(directions.shape[0] / rows)))
        labels, directions = labels[:, every, every], directions.thin(every, every)
    return Batch(batch.query, directions, labels)


@torch.no_grad()
def move_planes(model, batch: Batch, wavelength: float, least: float) -> list[float]:
    """Moves each used plane along its normal, or one that is square to the others, to the least
    error.

    The strongest plane comes first. ``least`` is the least distance searched on either side [m], up
    to ``WIDEST`` wavelengths. The result are the moves [m]. If a map is drawn, which takes long,
    planes keep their normals.
    """
    placement: Mirrored = model.placement
    placement.enable_phases(wavelength)  # adds the steps so far to the planes
    some, reach = thinned(batch, 12), max(4.0 * wavelength, min(least, WIDEST * wavelength))
    if least > reach:  # steps cannot be coarser than a fraction of the wavelength
        log.info(
            "planes are searched within %.3g m, not %.3g m; placement.walls can start nearer",
            reach,
            least,
        )
    planes = by_strength(placement, batch)
    moves = track(planes, "search of planes")
    return [_move(model, plane, reach, wavelength, some, model.takes_paths) for plane in moves]


def _move(model, plane: int, reach: float, wavelength: float, batch: Batch, square: bool) -> float:
    """Moves a plane along its normal, or along one of ``square_normals``, to the least error;
    returns the move [m].
    """
    placement: Mirrored = model.placement
    origin = placement.origin[plane]
    step = wavelength / 10  # a reflected path changes by twice of it
    moves = step * torch.arange(-round(reach / step), round(reach / step) + 1).to(origin)
    moves = moves[moves.abs().argsort(stable=True)]  # of equal errors the least move
    tried = []
    used = placement.used.tolist()
    for normal in (
        square_normals(placement.normals[used], used.index(plane))
        if square
        else (origin[:3].clone(),)
    ):
        origin[:3] = normal
        errors = _errors_of_moves(model, batch, plane, moves)
        best = int(errors.argmin())
        tried.append((errors[best].item(), moves[best].item(), normal))
    _, move, origin[:3] = min(tried, key=lambda found: found[0])
    origin[3] += move
    return move


def _errors_of_moves(
    model, batch: Batch, plane: int, moves: Float[Tensor, " m"]
) -> Float[Tensor, " m"]:
    """Mean absolute error, of channels log share, with a plane moved along its normal [m] and
    strengths held.
    """
    placement, query, labels, count = model.placement, batch.query, batch.labels, len(batch.query)
    errors = []
    with placement.holding():
        model.excite(query)
        held = placement.held
        numbers = max(1000, labels[0].numel())
        for some in moves.split(max(1, 2_000_000 // (count * numbers))):
            rows = torch.arange(count, device=moves.device).repeat(len(some))
            placement.held, placement.tried = held[rows], placement.offsets.repeat(len(rows), 1)
            placement.tried[:, plane] += some.repeat_interleave(count)
            moved = Batch(query[rows], batch.directions)
            value = model.respond(
                model.excite(moved.query), torch.arange(len(rows), device=rows.device), moved
            ).value
            label = model.scene.task.align(labels[rows], value)
            error, label = (part.reshape(len(rows), -1) for part in (value - label, label))
            if (
                error.is_complex()
            ):  # a loud channel must not rule, and a weak one has no squares in float32
                largest = label.abs().amax(1, keepdim=True).clamp_min(FAINTEST)
                apart = log_share(error / largest, label / largest)
            else:
                apart = error.abs().mean(1)
            errors.append(apart.view(len(some), count).mean(1))
    return torch.cat(errors)


def prune(placement: Mirrored, batches: list[Batch], loss: Loss) -> str:
    """Drops planes, then paths, that hardly lower any batch's loss, weakest first; returns a
    sentence for the log.
    """
    planes, paths = len(placement.used), int(placement.kept.sum())
    before = [loss(batch) for batch in batches]

    def is_good(kept: Bool[Tensor, " n"]) -> bool:
        placement.kept.copy_(kept)
        return all(
            loss(batch) <= old * (1 + 1e-3) for batch, old in zip(batches, before, strict=True)
        )

    best = placement.kept.clone()
    shares = torch.stack([_shares(placement, batch) for batch in batches]).amax(0)
    best[best.nonzero()[:, 0][shares < NEGLIGIBLE * shares.max()]] = False
    for plane in reversed(by_strength(placement, batches[0])):
        without = best & ~(placement.sequences == plane).any(1)
        best = without if is_good(without) else best
    placement.kept.copy_(best)
    weakest = best.nonzero()[:, 0][_shares(placement, batches[0]).argsort()]
    low, high = 0, len(weakest) - 1
    while low < high:  # the largest number of them that may go, by bisection
        middle = (low + high + 1) // 2
        without = best.index_fill(0, weakest[:middle], False)
        low, high = (middle, high) if is_good(without) else (low, middle - 1)
    placement.kept.copy_(best.index_fill(0, weakest[:low], False))
    return (
        f"{planes - len(placement.used)} of {planes} planes and {paths - int(placement.kept.sum())} of {paths} "
        f"paths dropped; loss {before[0]:.4f} -> {loss(batches[0]):.4f}"
    )


def by_strength(placement: Mirrored, batch: Batch) -> list[int]:
    """Used planes, strongest received power first."""
    shares, sequences = _shares(placement, batch), placement.sequences[placement.kept]
    return sorted(
        placement.used.tolist(), key=lambda plane: -shares[(sequences == plane).any(1)].sum().item()
    )


def _shares(placement: Mirrored, batch: Batch) -> Float[Tensor, " n"]:
    """Mean share of each kept path in a link's received power; 0 for a link without power."""
    query, _ = batch.query.unique(with_receivers=True)
    powers = placement(None, query).gains.abs().square()
    total = powers.sum(1, keepdim=True)
    return (powers / torch.where(total > 0, total, 1)).mean(0)
