"""The check of kind ``pooling``."""

import copy
import math
from collections.abc import Callable
from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from gaigs.core.antenna import Receiver
from gaigs.core.geometry import Grid
from gaigs.core.query import Query
from gaigs.core.scene import Scene
from gaigs.data import Links
from gaigs.splatting.pooling import Pooling
from gaigs.splatting.pooling.paths import PathPooling, ReceivedPaths
from gaigs.testing.checks import (
    PRECISION,
    require,
    require_close,
    require_gradients,
    require_same,
    require_tensor,
)


def check_pooling(
    build: Callable[[Scene], Pooling], links: Links, device: torch.device | str = "cpu"
) -> None:
    """Checks a pooling: the task's value for each map or set of paths, finite gradients,
    independence of the batch.

    ``build`` makes it for a scene. It is fitted to links of its task, and its twin has the same
    state. Silent maps and paths are among the inputs. A pooling of maps without a grid of its own
    is given maps over the label's directions and over a list of some of them. Any other is called
    with such a list. A pooling of maps whose label is one real number must also take maps that are
    constant, span 12 decades or are of half precision. The contract is that of
    ``gaigs.splatting.pooling.Pooling``.
    """
    pooling, task = build(links.scene), links.task
    takes_paths, grid = isinstance(pooling, PathPooling), pooling.grid
    require(
        isinstance(pooling.channels, int), f"channels must be a number, got {pooling.channels!r}"
    )
    require(
        not takes_paths or pooling.channels == 2,
        f"paths have 2 channels, got channels {pooling.channels}",
    )
    low, high = pooling.zone
    require(
        -math.pi / 2 <= low < high <= math.pi / 2,
        f"zone must be two elevations [rad], got {pooling.zone}",
    )
    require(
        grid is None or isinstance(grid, Grid),
        f"grid must be a Grid or None, got {type(grid).__name__}",
    )
    if grid is None:
        grid = task.directions
    require(
        takes_paths or grid is not None, f"labels of task {task.name!r} need a pooling with a grid"
    )
    pooling.fit(links)
    twin = build(links.scene)
    twin.load_state_dict(pooling.state_dict())
    receiver = links.query.receivers[0]
    same_receiver = (links.query.receivers == receiver).nonzero()[:, 0]
    for b, dtype in ((3, torch.float32), (1, torch.float32), (3, torch.float64)):
        module, other = (copy.deepcopy(part).to(device, dtype).eval() for part in (pooling, twin))
        query = links.query[same_receiver[:b]].to(device)
        received: Tensor | ReceivedPaths
        if takes_paths:
            noun, paths = "paths", example_paths(links.receivers[int(receiver)], query, dtype)
            names = ("means", "semi_axes", "amplitudes", "lengths", "coherences", "bandwidth")
            leaves = {name: getattr(paths, name).requires_grad_() for name in names}
            silent = torch.zeros_like(paths.amplitudes).requires_grad_()
            received, silence = paths, replace(paths, amplitudes=silent)
        else:
            noun, generator = "maps", torch.Generator().manual_seed(0)
            image = torch.randn(b, pooling.channels, *grid.shape, generator=generator).to(
                device, dtype
            )
            leaves = {"the map": image.requires_grad_()}
            received, silence = image, (silent := torch.zeros_like(image).requires_grad_())
        value = module(received, query)
        wanted = dtype.to_complex() if task.dtype.is_complex else dtype
        require_tensor("the value", value, (b, *task.shape), wanted, device)
        require_same(value, module(received, query), "two calls must give the same value")
        require_same(value, other(received, query), "a pooling's state dict must restore it")
        alone = module(rows_of(received, slice(-1, None)), query[-1:])
        require_close(
            alone, value[-1:], PRECISION[dtype], f"a value must not depend on the other {noun}"
        )
        require_gradients([value], dict(module.named_parameters()) | leaves)
        quiet = module(silence, query)
        require(quiet.isfinite().all(), "the value of silence must be finite")
        require_gradients([quiet], {f"silent {noun}": silent})
        none = module(rows_of(received, slice(0, 0)), query[:0])
        require(
            tuple(none.shape) == (0, *task.shape),
            f"no {noun} must give no values, got {tuple(none.shape)}",
        )
        if not takes_paths and pooling.grid is None:
            row = image.flatten(2)[:, :, None, ::3]
            single = module(row, query)
            require_tensor(
                "the value of a list of rays", single, (b, *row.shape[2:]), wanted, device
            )
            rule = "a list of rays must have the values of their pixels"
            require_close(single[:, 0], value.flatten(1)[:, ::3], PRECISION[dtype], rule)
        elif task.directions is not None:
            rays = task.directions.flatten()[1::3].to(device)
            rule = "fewer directions must get the same values"
            require_close(
                module(received, query, rays), value.flatten(1)[:, 1::3], PRECISION[dtype], rule
            )
        if not takes_paths and task.is_scalar:
            _check_hard_maps(module, image.detach(), query)


def example_paths(
    receiver: Receiver, query: Query, dtype: torch.dtype, n: int = 9
) -> ReceivedPaths:
    """Random paths to a receiver, partly coherent over a band, at the carriers of a query or else
    at 5 GHz.
    """
    generator = torch.Generator().manual_seed(1)
    b, random = (
        len(query),
        lambda *shape: torch.rand(*shape, generator=generator, dtype=torch.float64),
    )
    carriers = torch.full((b,), 5e9) if query.frequencies is None else query.frequencies
    amplitudes = torch.randn(b, n, generator=generator, dtype=torch.complex128)
    to = lambda part: part.to(query.transmitters.device, dtype)
    directions = torch.nn.functional.normalize(random(b, n, 3) - 0.5, dim=-1)
    points = to(directions * (1 + 5 * random(b, n, 1)))
    return ReceivedPaths(
        means=receiver.pose.to(points).world(points),
        semi_axes=to(0.3 * (random(b, n, 3, 3) - 0.5)),
        amplitudes=amplitudes.to(points.device, dtype.to_complex()),
        lengths=to(1 + 20 * random(b, n)),
        coherences=to(random(n)),
        bandwidth=to(torch.tensor(4e8)),
        receiver=receiver,
        carriers=to(carriers),
    )


def rows_of(received: Tensor | ReceivedPaths, rows: slice) -> Tensor | ReceivedPaths:
    """Some queries' maps or paths."""
    if isinstance(received, Tensor):
        return received[rows]
    names = ("means", "semi_axes", "amplitudes", "lengths", "carriers")
    return replace(received, **{name: getattr(received, name)[rows] for name in names})


def _check_hard_maps(
    pooling: Pooling, image: Float[Tensor, "b c rows columns"], query: Query
) -> None:
    """Levels and their gradients are finite; float32 where the map is of half precision, whose
    steps are 0.06 dB.
    """
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
