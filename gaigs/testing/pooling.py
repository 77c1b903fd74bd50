"""The check of kind ``pooling``."""

import copy
import math
from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from gaigs.core.antenna import Receiver
from gaigs.core.geometry import Grid
from gaigs.core.query import Query
from gaigs.core.scene import Scene
from gaigs.core.task import Task
from gaigs.data import Links
from gaigs.splatting.pooling import Pooling
from gaigs.splatting.pooling.paths import PathPooling, ReceivedPaths
from gaigs.testing.checks import (
    PRECISION,
    require,
    require_close,
    require_empty,
    require_gradients,
    require_same,
    require_tensor,
)


def check_pooling(
    build: Callable[[Scene], Pooling], links: Links, device: torch.device | str = "cpu"
) -> None:
    """Checks a pooling: values, finite gradients, independence of the batch.

    The pooling is fitted to the links, and a second one gets its state. Inputs include silent maps
    and paths. A pooling of maps without a grid is called with the label's directions, as a grid and
    as a list of some directions. Other poolings are called with such a list. A pooling of maps to
    one real number must also accept maps that are constant, span 12 decades or have half precision.
    The contract is in ``gaigs.splatting.pooling.Pooling``.

    Args:
        build: Function that makes the pooling for a scene.
        links: Links of its task, with a split.
        device: Device of the pooling and its inputs.
    """
    pooling = build(links.scene)
    grid = _check_attributes(pooling, links.task)
    pooling.fit(links)
    twin = build(links.scene)
    twin.load_state_dict(pooling.state_dict())
    receiver = links.query.receivers[0]
    same_receiver = (links.query.receivers == receiver).nonzero()[:, 0]
    for b, dtype in ((3, torch.float32), (1, torch.float32), (3, torch.float64)):
        module = copy.deepcopy(pooling).to(device, dtype).eval()
        query = links.query[same_receiver[:b]].to(device)
        if isinstance(pooling, PathPooling):
            inputs = _path_inputs(links.receivers[int(receiver)], query, dtype)
        else:
            inputs = _map_inputs(pooling.channels, grid, query, dtype)
        value = _check_values(module, links.task, inputs, query)
        restored = copy.deepcopy(twin).to(device, dtype).eval()(inputs.received, query)
        require_same(value, restored, "a pooling's state dict must restore it")
        _check_directions(module, links.task, inputs.received, query, value)
        if isinstance(inputs.received, Tensor) and links.task.is_scalar:
            _check_hard_maps(module, inputs.received.detach(), query)


class _PoolingInputs(NamedTuple):
    """Arguments of a pooling: received maps or paths, and silence of the same shape."""

    noun: str  # "maps" or "paths", for messages
    received: Tensor | ReceivedPaths
    leaves: dict[str, Tensor]  # tensors of ``received`` that get gradients, by name
    silence: Tensor | ReceivedPaths
    silent: Tensor  # the tensor of ``silence`` that gets a gradient


def _map_inputs(
    channels: int, grid: Grid | None, query: Query, dtype: torch.dtype
) -> _PoolingInputs:
    """Random maps over a grid, one for each link."""
    generator = torch.Generator().manual_seed(0)
    image = torch.randn(len(query), channels, *grid.shape, generator=generator)
    image = image.to(query.transmitters.device, dtype).requires_grad_()
    silence = torch.zeros_like(image).requires_grad_()
    return _PoolingInputs("maps", image, {"the map": image}, silence, silence)


def _path_inputs(receiver: Receiver, query: Query, dtype: torch.dtype) -> _PoolingInputs:
    """Paths of ``example_paths``, and the same paths with amplitudes of 0."""
    paths = example_paths(receiver, query, dtype)
    names = ("means", "semi_axes", "amplitudes", "lengths", "coherences", "bandwidth")
    leaves = {name: getattr(paths, name).requires_grad_() for name in names}
    silent = torch.zeros_like(paths.amplitudes).requires_grad_()
    return _PoolingInputs("paths", paths, leaves, replace(paths, amplitudes=silent), silent)


def _check_attributes(pooling: Pooling, task: Task) -> Grid | None:
    """Checks channels, zone and grid; returns the directions of a map, if there is one."""
    channels = pooling.channels
    require(isinstance(channels, int), f"channels must be a number, got {channels!r}")
    takes_paths = isinstance(pooling, PathPooling)
    suits = not takes_paths or channels == 2
    require(suits, f"paths have 2 channels, got channels {channels}")
    low, high = pooling.zone
    is_zone = -math.pi / 2 <= low < high <= math.pi / 2
    require(is_zone, f"zone must be two elevations [rad], got {pooling.zone}")
    grid = task.directions if pooling.grid is None else pooling.grid
    is_grid = grid is None or isinstance(grid, Grid)
    require(is_grid, f"grid must be a Grid or None, got {type(grid).__name__}")
    is_given = takes_paths or grid is not None
    require(is_given, f"labels of task {task.name!r} need a pooling with a grid")
    return grid


def _check_values(pooling: Pooling, task: Task, inputs: _PoolingInputs, query: Query) -> Tensor:
    """Checks values and gradients for all queries, the last one, no query, and silence.

    Returns:
        The values for all queries.
    """
    noun = inputs.noun
    received = inputs.received
    value = pooling(received, query)
    real = _real_dtype(received)
    dtype = real.to_complex() if task.dtype.is_complex else real
    device = query.transmitters.device
    require_tensor("the value", value, (len(query), *task.shape), dtype, device)
    require_same(value, pooling(received, query), "two calls must give the same value")
    alone = pooling(rows_of(received, slice(-1, None)), query[-1:])
    rule = f"a value must not depend on the other {noun}"
    require_close(alone, value[-1:], PRECISION[real], rule)
    require_gradients([value], dict(pooling.named_parameters()) | inputs.leaves)
    quiet = pooling(inputs.silence, query)
    require(quiet.isfinite().all(), "the value of silence must be finite")
    require_gradients([quiet], {f"silent {noun}": inputs.silent})
    none = pooling(rows_of(received, slice(0, 0)), query[:0])
    require_empty(none.shape, [(0, *task.shape)], f"no {noun} must give no values")
    return value


def _check_directions(
    pooling: Pooling, task: Task, received: Tensor | ReceivedPaths, query: Query, value: Tensor
) -> None:
    """Checks the values for a part of the label's directions, given as a list of rays.

    ``value`` has the values for all directions.
    """
    tolerance = PRECISION[_real_dtype(received)]
    if isinstance(received, Tensor) and pooling.grid is None:
        row = received.flatten(2)[:, :, None, ::3]  # every third pixel, as rays (b, c, 1, k)
        values = pooling(row, query)
        shape = (len(query), *row.shape[2:])
        require_tensor("the value of a list of rays", values, shape, value.dtype, value.device)
        rule = "a list of rays must have the values of their pixels"
        require_close(values[:, 0], value.flatten(1)[:, ::3], tolerance, rule)
    elif task.directions is not None:
        rays = task.directions.flatten()[1::3].to(value.device)  # every third direction
        values = pooling(received, query, rays)
        rule = "fewer directions must get the same values"
        require_close(values, value.flatten(1)[:, 1::3], tolerance, rule)


def _check_hard_maps(
    pooling: Pooling, image: Float[Tensor, "b c rows columns"], query: Query
) -> None:
    """Checks that extreme maps give finite levels and gradients, at least in single precision."""
    decades = torch.linspace(-6, 6, image[0].numel()).reshape(image.shape[1:]).to(image)
    maps = {
        "a silent map": 0 * image,
        "a constant map": torch.ones_like(image),
        "12 decades": 10**decades * image,
    }
    if image.dtype == torch.float32:
        maps |= {f"{name} in float16": m.clamp(-6e4, 6e4).half() for name, m in maps.items()}
    for name, leaf in maps.items():
        leaf.requires_grad_()
        value = pooling(leaf, query)
        dtype = torch.float32 if leaf.dtype == torch.half else leaf.dtype
        require_tensor(f"the value of {name}", value, value.shape, dtype)
        require_gradients([value], {**dict(pooling.named_parameters()), name: leaf})


def _real_dtype(received: Tensor | ReceivedPaths) -> torch.dtype:
    """The real dtype of maps or paths."""
    return received.dtype if isinstance(received, Tensor) else received.lengths.dtype


def rows_of(received: Tensor | ReceivedPaths, rows: slice) -> Tensor | ReceivedPaths:
    """Maps or paths of the queries in ``rows``."""
    if isinstance(received, Tensor):
        return received[rows]
    names = ("means", "semi_axes", "amplitudes", "lengths", "carriers")
    return replace(received, **{name: getattr(received, name)[rows] for name in names})


def example_paths(
    receiver: Receiver, query: Query, dtype: torch.dtype, n: int = 9
) -> ReceivedPaths:
    """Random paths, partly coherent over 0.4 GHz, at the query's carriers or else at 5 GHz."""
    generator = torch.Generator().manual_seed(1)
    device = query.transmitters.device
    b = len(query)

    def random(*shape: int) -> Tensor:
        return torch.rand(*shape, generator=generator, dtype=torch.float64)

    amplitudes = torch.randn(b, n, generator=generator, dtype=torch.complex128)
    directions = torch.nn.functional.normalize(random(b, n, 3) - 0.5, dim=-1)
    points = (directions * (1 + 5 * random(b, n, 1))).to(device, dtype)  # receiver's frame [m]
    carriers = torch.full((b,), 5e9) if query.frequencies is None else query.frequencies
    return ReceivedPaths(
        means=receiver.pose.to(points).world(points),
        semi_axes=(0.3 * (random(b, n, 3, 3) - 0.5)).to(device, dtype),
        amplitudes=amplitudes.to(device, dtype.to_complex()),
        lengths=(1 + 20 * random(b, n)).to(device, dtype),
        coherences=random(n).to(device, dtype),
        bandwidth=torch.tensor(4e8).to(device, dtype),
        receiver=receiver,
        carriers=carriers.to(device, dtype),
    )
