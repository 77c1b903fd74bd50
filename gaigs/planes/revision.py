"""Revisions of a room during the training: planes move, and weak planes and paths are dropped."""

import logging
from collections.abc import Callable

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from gaigs.core.geometry import FAINTEST, Grid
from gaigs.core.query import Batch
from gaigs.core.stages import track
from gaigs.planes.strengths import log_share
from gaigs.splatting.placement.mirrored.paths import Mirrored
from gaigs.splatting.placement.mirrored.reflections import square_normals

log = logging.getLogger(__name__)

Loss = Callable[[Batch], float]
"""A function that returns the model's present loss on a batch."""


def thin_batch(batch: Batch, rows: int) -> Batch:
    """The batch with fewer pixels: about ``rows`` rows of its maps, and columns in proportion.

    Labels without a grid of directions are unchanged.
    """
    labels = batch.labels
    directions = batch.directions
    if isinstance(directions, Grid):
        step = max(1, round(directions.shape[0] / rows))
        every = slice(None, None, step)
        labels = labels[:, every, every]
        directions = directions.thin(every, every)
    return Batch(batch.query, directions, labels)


@torch.no_grad()
def move_planes(
    model, batch: Batch, wavelength: float, least: float, widest: float = 50.0
) -> list[float]:
    """Moves each used plane to the position with the lowest error, the strongest plane first.

    A plane moves along its normal. It may also turn to be parallel or perpendicular to other
    planes, see ``square_normals``. Planes of a model that draws maps do not turn, since each trial
    takes long.

    Args:
        model: Model with a placement ``mirrored``.
        batch: Links for the errors.
        wavelength: Wavelength of the carrier [m].
        least: Distance searched on either side [m]; at least four wavelengths are searched.
        widest: Limit of ``least`` [wavelengths].

    Returns:
        Moves along the normals [m].
    """
    placement: Mirrored = model.placement
    placement.enable_phases(wavelength)  # adds the learnt moves so far to the planes' positions
    thinned = thin_batch(batch, 12)
    reach = max(4.0 * wavelength, min(least, widest * wavelength))
    if least > reach:  # steps cannot be coarser than a fraction of the wavelength
        log.info(
            "planes are searched within %.3g m, not %.3g m; placement.walls can start nearer",
            reach,
            least,
        )
    planes = track(sort_by_strength(placement, batch), "search of planes")
    turns = model.takes_paths
    return [move_plane(model, plane, reach, wavelength, thinned, turns) for plane in planes]


def move_plane(
    model, plane: int, reach: float, wavelength: float, batch: Batch, turns: bool
) -> float:
    """Moves a plane to the lowest error of a batch; returns the move along the normal [m].

    The plane moves by at most ``reach`` [m], in steps of a tenth of the ``wavelength`` [m]. With
    ``turns`` the normals of ``square_normals`` are also tried.
    """
    placement: Mirrored = model.placement
    origin = placement.origin[plane]  # normal and offset, a view that is changed in place
    step = wavelength / 10  # a reflected path changes by twice as much
    count = round(reach / step)
    moves = step * torch.arange(-count, count + 1).to(origin)
    # ``argmin`` takes the first of equal errors: the least move.
    moves = moves[moves.abs().argsort(stable=True)]
    normals = [origin[:3].clone()]
    if turns:
        used = placement.used.tolist()
        normals = square_normals(placement.normals[used], used.index(plane))
    trials = []
    for normal in normals:
        origin[:3] = normal
        errors = _measure_moves(model, batch, plane, moves)
        best = int(errors.argmin())
        trials.append((errors[best].item(), moves[best].item(), normal))
    _, move, origin[:3] = min(trials, key=lambda trial: trial[0])
    origin[3] += move
    return move


def _measure_moves(
    model, batch: Batch, plane: int, moves: Float[Tensor, " m"]
) -> Float[Tensor, " m"]:
    """Mean error of the links for each move [m] of a plane along its normal.

    Strengths of paths are computed once; only path lengths change with the move.
    """
    placement = model.placement
    count = len(batch.query)
    errors = []
    with placement.holding():
        model.excite(batch.query)
        strengths = placement.held
        numbers = max(1000, batch.labels[0].numel())
        moves_at_a_time = max(1, 2_000_000 // (count * numbers))  # limits memory
        for part in moves.split(moves_at_a_time):
            # All links for the first move, then all links for the second, ...
            rows = torch.arange(count, device=moves.device).repeat(len(part))
            placement.held = strengths[rows]
            placement.tried = placement.offsets.repeat(len(rows), 1)  # (moves x links, w)
            placement.tried[:, plane] += part.repeat_interleave(count)
            moved = Batch(batch.query[rows], batch.directions)
            numbered = torch.arange(len(rows), device=rows.device)
            value = model.respond(model.excite(moved.query), numbered, moved).value
            label = model.scene.task.align(batch.labels[rows], value)
            link_errors = _measure_links(value, label)
            errors.append(link_errors.view(len(part), count).mean(1))
    return torch.cat(errors)


def _measure_links(value: Tensor, label: Tensor) -> Float[Tensor, " b"]:
    """Error of each link: ``log_share`` for channels, otherwise the mean absolute error."""
    error = (value - label).reshape(len(value), -1)
    if not error.is_complex():
        return error.abs().mean(1)
    # Channels are scaled to a largest value of 1: squares of weak ones would be 0 in float32.
    label = label.reshape(len(value), -1)
    largest = label.abs().amax(1, keepdim=True).clamp_min(FAINTEST)
    return log_share(error / largest, label / largest)


def prune(placement: Mirrored, batches: list[Batch], loss: Loss, negligible: float = 1e-6) -> str:
    """Drops planes, then paths, weakest first, as long as no batch's loss rises by 0.1 %.

    Args:
        placement: Placement whose ``kept`` is changed.
        batches: Batches for the loss; the first one sorts planes and paths by power.
        loss: Loss of the model on a batch.
        negligible: Fraction of the strongest path's power below which a path is dropped without a
            test.

    Returns:
        A sentence for the log.
    """
    plane_count = len(placement.used)
    path_count = int(placement.kept.sum())
    before = [loss(batch) for batch in batches]

    def suffices(kept: Bool[Tensor, " n"]) -> bool:
        """Keeps only these paths; True if no batch's loss rises by 0.1 %."""
        placement.kept.copy_(kept)
        for batch, old_loss in zip(batches, before, strict=True):
            if not loss(batch) <= old_loss * (1 + 1e-3):  # also if it is NaN
                return False
        return True

    best = placement.kept.clone()  # True for the paths that stay
    shares = torch.stack([_path_shares(placement, batch) for batch in batches]).amax(0)
    paths_in_use = best.nonzero()[:, 0]
    best[paths_in_use[shares < negligible * shares.max()]] = False
    for plane in reversed(sort_by_strength(placement, batches[0])):
        without_plane = best & ~(placement.sequences == plane).any(1)
        best = without_plane if suffices(without_plane) else best
    placement.kept.copy_(best)
    order = _path_shares(placement, batches[0]).argsort()
    weakest = best.nonzero()[:, 0][order]  # numbers of the paths, the weakest first
    # The largest number of weak paths that may go, by bisection.
    low, high = 0, len(weakest) - 1
    while low < high:
        middle = (low + high + 1) // 2
        if suffices(best.index_fill(0, weakest[:middle], False)):
            low = middle
        else:
            high = middle - 1
    placement.kept.copy_(best.index_fill(0, weakest[:low], False))
    return (
        f"{plane_count - len(placement.used)} of {plane_count} planes and "
        f"{path_count - int(placement.kept.sum())} of {path_count} "
        f"paths dropped; loss {before[0]:.4f} -> {loss(batches[0]):.4f}"
    )


def sort_by_strength(placement: Mirrored, batch: Batch) -> list[int]:
    """Numbers of used planes, sorted by the received power of their paths, strongest first."""
    shares = _path_shares(placement, batch)
    sequences = placement.sequences[placement.kept]
    powers = {}
    for plane in placement.used.tolist():
        has_plane = (sequences == plane).any(1)  # (n,)
        powers[plane] = shares[has_plane].sum().item()
    return sorted(powers, key=lambda plane: -powers[plane])


def _path_shares(placement: Mirrored, batch: Batch) -> Float[Tensor, " n"]:
    """Fraction of each kept path in the received power, averaged over links.

    A link without power counts as 0.
    """
    query, _ = batch.query.unique(with_receivers=True)
    powers = placement(None, query).gains.abs().square()
    total = powers.sum(1, keepdim=True)
    return (powers / torch.where(total > 0, total, 1)).mean(0)
