"""The check of kind ``pooling``."""

import copy
import math
from collections.abc import Callable
from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from gaigs.antenna import Receiver
from gaigs.data import Links
from gaigs.geometry import Grid
from gaigs.pooling import Pooling
from gaigs.pooling.paths import PathPooling, ReceivedPaths
from gaigs.query import Query
from gaigs.scene import Scene
from gaigs.testing.checks import PRECISION, require, require_close, require_gradients, require_tensor


def check_pooling(build: Callable[[Scene], Pooling], links: Links, device: torch.device | str = "cpu") -> None:
    """A pooling: the task's value for each map or set of paths, finite gradients, independence of the batch.

    It is fitted to the links, and its twin has the same state. Silent maps and paths are among the inputs. A pooling of
    maps without a grid of its own is given maps over the label's directions and over a list of some of them. Any other
    is asked for these. A pooling of maps that gives a real number a link must also take maps that are constant, span 12
    decades or are of half precision.

    Args:
        build: Makes the pooling for a scene.
        links: Links of the task that it is made for; it is fitted to them.
        device: Device of its inputs.

    Raises:
        AssertionError: It breaks the contract of ``gaigs.pooling.Pooling``.
    """
    pooling, task = build(links.scene), links.task
    channels, takes_paths = pooling.channels, isinstance(pooling, PathPooling)
    require(isinstance(channels, int) and channels > 0, f"channels must be how many it needs, got {channels!r}")
    require(not takes_paths or channels == 2, f"paths have 2 channels, real and imaginary part, got {channels}")
    _check_grid(pooling)
    pooling.fit(links)
    twin = build(links.scene)
    twin.load_state_dict(pooling.state_dict())
    grid = task.directions if pooling.grid is None else pooling.grid
    rule = f"labels of task {task.name!r} have no directions, so the pooling must have a grid"
    require(takes_paths or grid is not None, rule)
    for b, dtype in ((3, torch.float32), (1, torch.float32), (3, torch.float64)):
        module, other = (copy.deepcopy(part).to(device, dtype).eval() for part in (pooling, twin))
        query = _query(links, b).to(device)
        if takes_paths:
            what, received = "paths", example_paths(links.receivers[int(query.receivers[0])], query, dtype)
            names = ("means", "semi_axes", "amplitudes", "lengths", "coherences", "bandwidth")
            leaves = {name: getattr(received, name).requires_grad_() for name in names}
            silence = replace(received, amplitudes=torch.zeros_like(received.amplitudes).requires_grad_())
            silent = {"silent paths": silence.amplitudes}
        else:
            generator = torch.Generator().manual_seed(0)
            what, received = "maps", torch.randn(b, channels, *grid.shape, generator=generator).to(device, dtype)
            leaves = {"the map": received.requires_grad_()}
            silence = torch.zeros_like(received).requires_grad_()
            silent = {"a silent map": silence}
        value = module(received, query)
        wanted = dtype.to_complex() if task.dtype.is_complex else dtype
        require_tensor("the value", value, (b, *task.shape), wanted, device)
        require(torch.equal(value, module(received, query)), "two calls must give the same value")
        require(torch.equal(value, other(received, query)), "all that it takes in fit must be in the state dict")
        alone = module(rows_of(received, slice(-1, None)), query[-1:])
        require_close(alone, value[-1:], PRECISION[dtype], f"a value must not depend on the other {what}")
        require_gradients([value], dict(module.named_parameters()) | leaves)
        quiet = module(silence, query)
        require(bool(quiet.isfinite().all()), "the value of silence must be finite")
        require_gradients([quiet], silent)
        none = module(rows_of(received, slice(0, 0)), query[:0])
        require(tuple(none.shape) == (0, *task.shape), f"no {what} must give no values, got {tuple(none.shape)}")
        if not takes_paths and pooling.grid is None:
            row = received.flatten(2)[:, :, None, ::3]
            single = module(row, query)
            require_tensor("the value of a list of rays", single, (b, *row.shape[2:]), wanted, device)
            rule = "a list of rays must have the values of their pixels"
            require_close(single[:, 0], value.flatten(1)[:, ::3], PRECISION[dtype], rule)
        elif task.directions is not None:
            rays = task.directions.flatten()[1::3].to(device)
            rule = "fewer directions must get the same values"
            require_close(module(received, query, rays), value.flatten(1)[:, 1::3], PRECISION[dtype], rule)
        if not takes_paths and task.shape == () and not task.dtype.is_complex:
            _check_hard_maps(module, received.detach(), query)


def example_paths(receiver: Receiver, query: Query, dtype: torch.dtype, n: int = 9) -> ReceivedPaths:
    """Random paths to a receiver, partly coherent over a band, at the carriers of a query or else at 5 GHz."""
    generator = torch.Generator().manual_seed(1)
    b, random = len(query), lambda *shape: torch.rand(*shape, generator=generator, dtype=torch.float64)
    carriers = torch.full((b,), 5e9) if query.frequencies is None else query.frequencies
    amplitudes = torch.randn(b, n, generator=generator, dtype=torch.complex128)
    to = lambda part: part.to(query.transmitters.device, dtype)
    directions = torch.nn.functional.normalize(random(b, n, 3) - 0.5, dim=-1)
    points = to(directions * (1 + 5 * random(b, n, 1)))
    means = receiver.pose.to(points).world(points)
    return ReceivedPaths(
        means,
        to(0.3 * (random(b, n, 3, 3) - 0.5)),
        amplitudes.to(means.device, dtype.to_complex()),
        to(1 + 20 * random(b, n)),
        to(random(n)),
        to(torch.tensor(4e8)),
        receiver,
        to(carriers),
    )


def rows_of(received: Tensor | ReceivedPaths, rows: slice) -> Tensor | ReceivedPaths:
    """Some queries' maps or paths."""
    if isinstance(received, Tensor):
        return received[rows]
    shared = {"semi_axes"} if len(received.semi_axes) == 1 else set()
    names = {"means", "semi_axes", "amplitudes", "lengths", "carriers"} - shared
    return replace(received, **{name: getattr(received, name)[rows] for name in names})


def _check_grid(pooling: Pooling) -> None:
    low, high = pooling.zone
    require(-math.pi / 2 <= low < high <= math.pi / 2, f"zone must be two elevations [rad], got {pooling.zone}")
    if pooling.grid is not None:
        require(isinstance(pooling.grid, Grid), f"grid must be a Grid or None, got {type(pooling.grid).__name__}")
        require(min(pooling.grid.shape) > 0, f"grid must have pixels, got {pooling.grid.shape}")


def _query(links: Links, count: int) -> Query:
    """Some links to one receiver."""
    receiver = links.query.receivers[0]
    return links.query[(links.query.receivers == receiver).nonzero()[:count, 0]]


def _check_hard_maps(pooling: Pooling, image: Float[Tensor, "b c rows columns"], query: Query) -> None:
    """Levels and their gradients are finite; float32 where the map is of half precision, whose steps are 0.06 dB."""
    decades = torch.linspace(-6, 6, image[0].numel()).reshape(image.shape[1:]).to(image)
    maps = {"a silent map": 0 * image, "a constant map": torch.ones_like(image), "12 decades": 10**decades * image}
    if image.dtype == torch.float32:
        maps |= {f"{name} in float16": m.clamp(-6e4, 6e4).half() for name, m in maps.items()}
    for name, leaf in maps.items():
        leaf.requires_grad_()
        value = pooling(leaf, query)
        dtype = torch.float32 if leaf.dtype == torch.half else leaf.dtype
        require(value.dtype == dtype, f"the value of {name} must be {dtype}, got {value.dtype}")
        require(bool(value.isfinite().all()), f"the value of {name} must be finite")
        require_gradients([value], {**dict(pooling.named_parameters()), name: leaf})
