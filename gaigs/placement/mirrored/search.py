"""Which planes a room has: those whose reflections explain what the others leave."""

import math
from collections.abc import Callable

import torch
from jaxtyping import Complex, Float, Int
from torch import Tensor
from torch.nn import functional

from gaigs.directions import Grid
from gaigs.gaussians import fibonacci_lattice
from gaigs.placement.mirrored import CONDUCTIVITY, PERMITTIVITY
from gaigs.placement.mirrored.reflections import reflect
from gaigs.projection import Splats
from gaigs.propagation import NEAREST, fresnel
from gaigs.query import Batch

SLANTS, OFFSETS = 24, 24
"""Normals over the sphere, beside the axes and the normals there are, and offsets across the room, of the first try."""

CLOSER, ROUNDS = 96, 3
"""Planes about the best one that are tried next, and how often, each time at a third of the distance."""

TURN = 0.15
"""Standard deviation of their normals the first time [rad]."""

MARGIN = 0.1
"""How far beyond the box of transmitters and receivers a plane may be, in its diagonals."""

GAIN = 0.01
"""By how much a plane must lower the loss to be taken in: less is the chance of the links looked at."""

ROWS = 12
"""Rows of the labels that searches look at: a search takes hundreds of looks."""

FEW = 6
"""Rows where only powers are looked at, which change slowly with direction."""

AT_ONCE = 4000
"""Pairs of a link and a plane worked on at a time."""


def find_planes(model, train: Batch, validation: Batch | None, loss: Callable[[Batch], float]) -> str:
    """Takes in one plane after the other, wherever its reflection lowers the loss most, as long as it does.

    Where powers add, so do lags: those of one more reflection are added to what the model hears already, for hundreds
    of planes at a time.

    Args:
        model: ``gaigs.model.mirrored.Mirrored``.
        train, validation: Links to look at.
        loss: Of the model as it stands, on a batch.

    Returns:
        What was found, in words.
    """
    placement = model.placement
    if model.pooling.takes != "lags" or model.draws_map:
        return "planes stay those of the box of transmitters and receivers"
    batches = [batch for batch in (train, validation) if batch is not None]
    before, told = loss(train), []
    while len(placement.used) < len(placement.origin):
        used = placement.used
        plane = next(k for k in range(len(placement.origin)) if k not in used)
        kept, losses = placement.kept.clone(), [loss(batch) for batch in batches]
        normal, offset = _best(model, train)
        placement.place(plane, normal, offset)
        placement.kept |= placement.words_of(torch.cat((used, used.new_tensor([plane]))))
        after = [loss(batch) for batch in batches]
        if any(new > (1 - GAIN) * old for new, old in zip(after, losses, strict=True)):
            placement.kept.copy_(kept)
            break
        numbers = ", ".join(f"{value:.2f}" for value in (*normal.tolist(), offset))
        told.append(f"plane ({numbers})")
    return f"{' and '.join(told) or 'no plane'} found; loss {before:.4f} -> {loss(train):.4f}"


def fewer(batch: Batch, rows: int = ROWS) -> Batch:
    """A batch with some of its labels' rows and columns, where these have a grid."""
    labels, directions = batch.labels, batch.directions
    if isinstance(directions, Grid):
        every = slice(None, None, max(1, directions.shape[0] // rows))
        labels, directions = labels[:, every, every], directions.thin(every, every)
    return Batch(batch.query, directions, labels)


def _best(model, batch: Batch) -> tuple[Float[Tensor, "3"], float]:
    """The plane whose reflections lower the mean absolute error most."""
    placement = model.placement
    lower, upper = (corner.to(placement.origin) for corner in placement.box)
    corners = torch.cartesian_prod(*torch.stack((lower, upper), 1))
    axes = torch.eye(3).to(corners)
    found = placement.normals[placement.used]
    across = functional.normalize(
        torch.linalg.cross(found, axes[2].expand_as(found)), dim=1
    )  # walls meet at right angles
    normals = torch.cat(
        (axes, -axes, found, -found, across, -across, fibonacci_lattice(SLANTS, -math.pi / 2, math.pi / 2).to(axes))
    )
    normals = normals[normals.norm(dim=1) > 0.5]
    along = normals @ corners.T
    margin = MARGIN * placement.diagonal
    low, high = along.amin(1) - margin, along.amax(1) + margin
    shares = torch.linspace(0, 1, OFFSETS).to(low)
    offsets = low[:, None] + (high - low)[:, None] * shares
    pitch = float((high - low).max()) / (OFFSETS - 1)
    normals, offsets = normals[:, None].expand(-1, OFFSETS, -1).flatten(0, 1), offsets.flatten()
    batch = fewer(batch, FEW)
    heard = _heard(model, batch)
    turn = TURN
    for _ in range(ROUNDS + 1):
        errors = _errors(model, batch, heard, normals, offsets)
        best = int(errors.argmin())
        normal, offset = normals[best], offsets[best]
        normals = functional.normalize(normal + turn * torch.randn(CLOSER, 3).to(normal), dim=1)
        # About the middle of the room, not about the world's origin.
        middle = (lower + upper) / 2
        offsets = offset - middle @ normal + normals @ middle + pitch * (torch.rand(CLOSER).to(normal) - 0.5) * 2
        normals[0], offsets[0] = normal, offset
        turn, pitch = turn / 3, pitch / 3
    return normal, offset.item()


def _heard(model, batch: Batch) -> list[tuple[int, Int[Tensor, "k"], Complex[Tensor, "k l"]]]:
    """Each receiver, its links, and the lags that they hear now."""
    query = batch.query
    excited = model._excite(query)
    heard = []
    for receiver in query.receivers.unique().tolist():
        own = (query.receivers == receiver).nonzero()[:, 0]
        heard.append((receiver, own, model._sum(*excited, own, receiver, query[own])))
    return heard


def _errors(model, batch: Batch, heard: list[tuple], normals: Tensor, offsets: Tensor) -> Float[Tensor, "c"]:
    """Mean absolute error with the reflection at one more plane, of each of some planes."""
    totals = []
    count = len(batch.query)
    size = max(1, AT_ONCE // count)
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
    places = batch.query.transmitters[own]
    points = reflect(places[:, None].expand(-1, count, -1), normals, offsets)
    seen = points - pose.position
    lengths = seen.norm(dim=-1).clamp_min(NEAREST)
    # A reflection takes both ends on one side.
    sides = (places @ normals.T - offsets) * (pose.position @ normals.T - offsets)
    directions = (seen / lengths[..., None]) @ pose.rotation
    te, tm = fresnel(complex(PERMITTIVITY, -CONDUCTIVITY), (seen * normals).sum(-1).abs() / lengths)
    level = normals[:, 2].square()
    gains = ((1 - level) * te + level * tm) * placement.pattern(receiver, directions) * (sides > 0) / lengths
    gains = gains * placement.receiver_gains[receiver].exp()
    flat = lambda values: values.flatten(0, 1)[:, None]
    splats = Splats(flat(directions[..., :2]), normals.new_zeros(1, 1, 3), flat(lengths), flat(sides > 0))
    links = own.repeat_interleave(count)
    query = batch.query[links]
    more = model.rasterizer.lags(
        splats, flat(gains), flat(lengths), normals.new_zeros(1), None, antenna.array, model._carriers(query)
    )
    lags = lags.repeat_interleave(count, 0) + more
    directions, labels = batch.directions, batch.labels[own]
    value = model.pooling.hear(lags, query, directions)
    value = model._on_trend(value, Batch(query, directions))
    errors = (value.unflatten(0, (len(own), count)) - labels[:, None]).abs()
    return errors.flatten(2).mean(-1) if errors.ndim > 2 else errors
