"""Search for planes: new planes, their normals and offsets by the phases, and planes and paths to drop."""

import logging
import math
from collections.abc import Callable

import torch
from jaxtyping import Bool, Complex, Float, Int
from scipy.constants import speed_of_light
from torch import Tensor
from torch.nn import functional

from gaigs.gaussians import fibonacci_lattice
from gaigs.geometry import FAINTEST, Grid
from gaigs.placement.mirrored.channel_search import log_share
from gaigs.placement.mirrored.lag_search import WIDEST
from gaigs.placement.mirrored.paths import CONDUCTIVITY, PERMITTIVITY, Mirrored
from gaigs.placement.mirrored.reflections import polarised, reflect, square_normals
from gaigs.projection import Splats
from gaigs.propagation import NEAREST, fresnel
from gaigs.query import Batch

log = logging.getLogger(__name__)

Loss = Callable[[Batch], float]
"""Loss of the model as it stands, on a batch."""


def find_planes(model, train: Batch, validation: Batch | None, loss: Loss) -> str:
    """Adds one plane after the other, where its reflection lowers the loss most, as long as it lowers the loss.

    If powers add, so do lags: those of one more reflection are added to the model's, for hundreds of planes at a time.
    The result is a sentence for the log.
    """
    placement = model.placement
    batches = [batch for batch in (train, validation) if batch is not None]
    before, found = loss(train), []
    while len(placement.used) < len(placement.origin):
        used = placement.used
        plane = next(k for k in range(len(placement.origin)) if k not in used)
        kept, losses = placement.kept.clone(), [loss(batch) for batch in batches]
        normal, offset = _best(model, train)
        placement.place(plane, normal, offset)
        placement.kept |= placement.sequences_of(torch.cat((used, used.new_tensor([plane]))))
        after = [loss(batch) for batch in batches]
        # By less than a hundredth a plane may lower the loss by chance.
        if any(new > 0.99 * old for new, old in zip(after, losses, strict=True)):
            placement.kept.copy_(kept)
            break
        world = offset + float(normal @ placement.middle)
        numbers = ", ".join(f"{value:.2f}" for value in (*normal.tolist(), world))
        found.append(f"plane ({numbers})")
    return f"{' and '.join(found) or 'no plane'} found; loss {before:.4f} -> {loss(train):.4f}"


def thinned(batch: Batch, rows: int = 12) -> Batch:
    """A batch with about ``rows`` of its labels' rows, and columns in proportion."""
    labels, directions = batch.labels, batch.directions
    if isinstance(directions, Grid):
        every = slice(None, None, max(1, round(directions.shape[0] / rows)))
        labels, directions = labels[:, every, every], directions.thin(every, every)
    return Batch(batch.query, directions, labels)


def _best(model, batch: Batch) -> tuple[Float[Tensor, "3"], float]:
    """The plane whose reflections lower the mean absolute error most: of a grid, then of planes about the best."""
    slants, pitches, closer, rounds = 24, 24, 96, 3
    placement = model.placement
    lower, upper = (corner.to(placement.origin) - placement.middle for corner in placement.box)
    corners = torch.cartesian_prod(*torch.stack((lower, upper), 1))
    axes = torch.eye(3).to(corners)
    found = placement.normals[placement.used]
    across = functional.normalize(
        torch.linalg.cross(found, axes[2].expand_as(found)), dim=1
    )  # walls meet at right angles
    normals = torch.cat(
        (axes, -axes, found, -found, across, -across, fibonacci_lattice(slants, -math.pi / 2, math.pi / 2).to(axes))
    )
    normals = normals[normals.norm(dim=1) > 0.5]
    along = normals @ corners.T
    margin = 0.1 * placement.diagonal
    low, high = along.amin(1) - margin, along.amax(1) + margin
    shares = torch.linspace(0, 1, pitches).to(low)
    offsets = low[:, None] + (high - low)[:, None] * shares
    pitch = float((high - low).max()) / (pitches - 1)
    normals, offsets = normals[:, None].expand(-1, pitches, -1).flatten(0, 1), offsets.flatten()
    batch = thinned(batch, 6)  # powers change slowly with direction
    heard = _heard(model, batch)
    turn = 0.15  # standard deviation of the tried normals [rad]
    for _ in range(rounds + 1):
        errors = _errors(model, batch, heard, normals, offsets)
        best = int(errors.argmin())
        normal, offset = normals[best], offsets[best]
        normals = functional.normalize(normal + turn * torch.randn(closer, 3).to(normal), dim=1)
        offsets = offset + pitch * (torch.rand(closer).to(normal) - 0.5) * 2
        normals[0], offsets[0] = normal, offset
        turn, pitch = turn / 3, pitch / 3
    return normal, offset.item()


def _heard(model, batch: Batch) -> list[tuple[int, Int[Tensor, " k"], Complex[Tensor, "k l"]]]:
    """Each receiver, its links, and the model's lags of them."""
    query = batch.query
    excited = model.excite(query)
    heard = []
    for receiver in query.receivers.unique().tolist():
        own = (query.receivers == receiver).nonzero()[:, 0]
        heard.append((receiver, own, model.pooling.sum_paths(model.paths(excited, own, receiver, query[own]))))
    return heard


def _errors(model, batch: Batch, heard: list[tuple], normals: Tensor, offsets: Tensor) -> Float[Tensor, " c"]:
    """Mean absolute error with the reflection at one more plane, of each of some planes."""
    totals = []
    count = len(batch.query)
    size = max(1, 4000 // count)  # 4000 pairs of a link and a plane at a time
    for n, d in zip(normals.split(size), offsets.split(size), strict=True):
        errors = normals.new_zeros(count, len(n))
        for receiver, own, lags in heard:
            errors[own] = _with_one_more(model, batch, lags, own, receiver, n, d)
        totals.append(errors.mean(0))
    return torch.cat(totals)


def _with_one_more(model, batch: Batch, lags, own, receiver: int, normals, offsets) -> Float[Tensor, "b c"]:
    placement, count = model.placement, len(normals)
    antenna = model.scene.receivers[receiver]
    pose = antenna.pose.to(normals)
    places, here = batch.query.transmitters[own] - placement.middle, pose.position - placement.middle
    points = reflect(places[:, None].expand(-1, count, -1), normals, offsets)
    seen = points - here
    lengths = seen.norm(dim=-1).clamp_min(NEAREST)
    # A reflection takes both ends on one side.
    sides = (places @ normals.T - offsets) * (here @ normals.T - offsets)
    directions = (seen / lengths[..., None]) @ pose.rotation
    te, tm = fresnel(complex(PERMITTIVITY, -CONDUCTIVITY), (seen * normals).sum(-1).abs() / lengths)
    gains = polarised(normals, te, tm) * placement.pattern(receiver, directions) * (sides > 0) / lengths
    gains = gains * placement.receiver_gains[receiver].exp()
    flat = lambda values: values.flatten(0, 1)[:, None]
    splats = Splats(flat(directions[..., :2]), normals.new_zeros(1, 1, 3), flat(lengths), flat(sides > 0))
    links = own.repeat_interleave(count)
    query = batch.query[links]
    own_paths = flat(gains), flat(lengths), normals.new_zeros(1), None
    more = model.pooling.covariances(splats, *own_paths, antenna.array, model.carriers(query))
    lags = lags.repeat_interleave(count, 0) + more
    directions, labels = batch.directions, batch.labels[own]
    value = model.pooling.read(lags, query, directions)
    value = model.on_trend(value, Batch(query, directions))
    errors = (value.unflatten(0, (len(own), count)) - labels[:, None]).abs()
    return errors.flatten(2).mean(-1) if errors.ndim > 2 else errors


# --- by phases ---


@torch.no_grad()
def move_planes(model, batch: Batch, wavelength: float, least: float) -> list[float]:
    """Moves each used plane along its normal, or one that is square to the others, to the least error.

    The strongest plane comes first. ``least`` is the least distance searched on either side [m], up to ``WIDEST``
    wavelengths. The result are the moves [m]. If a map is drawn, which takes long, planes keep their normals.
    """
    placement: Mirrored = model.placement
    placement.enable_phases(wavelength)  # adds the steps so far to the planes
    some, reach = thinned(batch), max(4.0 * wavelength, min(least, WIDEST * wavelength))
    if least > reach:  # steps cannot be coarser than a fraction of the wavelength
        log.info("planes are searched within %.3g m, not %.3g m; placement.walls can start nearer", reach, least)
    planes = by_strength(placement, batch)
    return [_move(model, plane, reach, wavelength, some, model.takes_paths) for plane in planes]


@torch.no_grad()
def choose_bandwidth(model, wavelength: float, batch: Batch, loss: Loss) -> None:
    """Takes the bandwidth with which moving the two strongest planes lowers the loss most."""
    placement: Mirrored = model.placement
    used = by_strength(placement, batch)
    origin, losses = placement.origin.clone(), {}
    # From a carrier, where all paths interfere, to a band in which hardly two do.
    for rooms in (0.01, 1.0, 3.0, 10.0, 30.0, 100.0):
        placement.log_bandwidth.fill_(math.log(rooms * speed_of_light / placement.diagonal))
        for plane in used[:2]:
            _move(model, plane, 4.0 * wavelength, wavelength, batch)
        losses[rooms] = loss(batch)
        placement.origin.copy_(origin)
    best = min(losses, key=losses.__getitem__)
    placement.log_bandwidth.fill_(math.log(best * speed_of_light / placement.diagonal))


def _move(model, plane: int, reach: float, wavelength: float, batch: Batch, square: bool = False) -> float:
    """Moves a plane along its normal, or along one of ``square_normals``, to the least error; returns the move [m]."""
    placement: Mirrored = model.placement
    origin = placement.origin[plane]
    step = wavelength / 10  # a reflected path changes by twice of it
    moves = step * torch.arange(-round(reach / step), round(reach / step) + 1).to(origin)
    moves = moves[moves.abs().argsort(stable=True)]  # of equal errors the least move
    tried = []
    used = placement.used.tolist()
    for normal in square_normals(placement.normals[used], used.index(plane)) if square else (origin[:3].clone(),):
        origin[:3] = normal
        errors = _errors_of_moves(model, batch, plane, moves)
        best = int(errors.argmin())
        tried.append((errors[best].item(), moves[best].item(), normal))
    _, move, origin[:3] = min(tried, key=lambda found: found[0])
    origin[3] += move
    return move


def _errors_of_moves(model, batch: Batch, plane: int, moves: Float[Tensor, " m"]) -> Float[Tensor, " m"]:
    """Mean absolute error, of channels log share, with a plane moved along its normal [m] and strengths held."""
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
            value = model.respond(model.excite(moved.query), torch.arange(len(rows), device=rows.device), moved).value
            label = model.scene.task.align(labels[rows], value)
            error, label = (part.reshape(len(rows), -1) for part in (value - label, label))
            if error.is_complex():  # a loud channel must not rule, and a weak one has no squares in float32
                largest = label.abs().amax(1, keepdim=True).clamp_min(FAINTEST)
                apart = log_share(error / largest, label / largest)
            else:
                apart = error.abs().mean(1)
            errors.append(apart.view(len(some), count).mean(1))
    return torch.cat(errors)


# --- pruning ---


def prune(placement: Mirrored, batches: list[Batch], loss: Loss) -> str:
    """Drops planes, then paths, weakest first, that hardly lower any batch's loss; returns a sentence for the log."""
    planes, paths = len(placement.used), int(placement.kept.sum())
    before = [loss(batch) for batch in batches]

    def is_good(kept: Bool[Tensor, " n"]) -> bool:
        placement.kept.copy_(kept)
        # A tenth of the gain that adds a plane.
        return all(loss(batch) <= old * (1 + 1e-3) for batch, old in zip(batches, before, strict=True))

    best = placement.kept.clone()
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
    return sorted(placement.used.tolist(), key=lambda plane: -shares[(sequences == plane).any(1)].sum().item())


def _shares(placement: Mirrored, batch: Batch) -> Float[Tensor, " n"]:
    """Mean share of each kept path in a link's received power; 0 for a link without power."""
    query, _ = batch.query.unique(with_receivers=True)
    powers = placement(None, query).gains.abs().square()
    total = powers.sum(1, keepdim=True)
    return (powers / torch.where(total > 0, total, 1)).mean(0)
