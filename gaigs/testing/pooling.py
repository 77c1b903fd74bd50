"""The check of kind ``pooling``."""

import copy
import functools
import math
from collections.abc import Callable

import torch
from jaxtyping import Complex, Float
from torch import Tensor

from gaigs.data import Links
from gaigs.directions import Directions, Grid
from gaigs.pooling import Pooling
from gaigs.query import Query
from gaigs.scene import Array, Scene
from gaigs.testing.checks import PRECISION, require, require_close, require_gradients, require_tensor


def check_pooling(build: Callable[[Scene], Pooling], links: Links, device: torch.device | str = "cpu") -> None:
    """A pooling: the task's value for each map, gradients finite even where the map is 0, independence of the batch.

    It is fitted to the links, and its twin has the same state. One that has no grid of its own is given maps over the
    label's directions and over a list of some of them, any other is asked for these. One that gives a real number a
    link must also take maps that are constant, span 12 decades or are of half precision. One that takes lags or fields
    is given some, and silence.

    Args:
        build: Makes the pooling for a scene.
        links: What it is fitted to; of the task that it is made for.
        device: Where it works.

    Raises:
        AssertionError: It breaks the contract of ``gaigs.pooling.Pooling``.
    """
    pooling, task = build(links.scene), links.task
    channels = pooling.channels
    require(isinstance(channels, int) and channels > 0, f"channels must be how many it needs, got {channels!r}")
    _check_grid(pooling)
    pooling.fit(links)
    twin = build(links.scene)
    twin.load_state_dict(pooling.state_dict())
    grid = task.directions if pooling.grid is None else pooling.grid
    require(grid is not None, f"labels of task {task.name!r} have no directions, so the pooling must have a grid")
    for b, dtype in ((3, torch.float32), (1, torch.float32), (3, torch.float64)):
        module, other = (copy.deepcopy(part).to(device, dtype).eval() for part in (pooling, twin))
        query = _query(links, b).to(device)
        generator = torch.Generator().manual_seed(0)
        image = torch.randn(b, channels, *grid.shape, generator=generator).to(device, dtype).requires_grad_()
        value = module(image, query)
        wanted = dtype.to_complex() if task.dtype.is_complex else dtype
        require_tensor("the value", value, (b, *task.shape), wanted, device)
        require(torch.equal(value, module(image, query)), "two calls must give the same value")
        require(torch.equal(value, other(image, query)), "all that it takes in fit must be in the state dict")
        alone = module(image[-1:], query[-1:])
        require_close(alone, value[-1:], PRECISION[dtype], "a value must not depend on the other maps")
        require_gradients([value], {**dict(module.named_parameters()), "the map": image})
        silence = torch.zeros_like(image).requires_grad_()
        require_gradients([module(silence, query)], {"a silent map": silence})
        none = module(image[:0], query[:0])
        require(tuple(none.shape) == (0, *task.shape), f"no maps must give no values, got {tuple(none.shape)}")
        if pooling.grid is None:
            row = image.flatten(2)[:, :, None, ::3]
            single = module(row, query)
            require_tensor("the value of a list of rays", single, (b, *row.shape[2:]), wanted, device)
            rule = "a list of rays must have the values of their pixels"
            require_close(single[:, 0], value.flatten(1)[:, ::3], PRECISION[dtype], rule)
        else:
            _check_directions(functools.partial(module, image, query), links, value)
        _check_hearing(module, other, links, query, dtype)
        if task.shape == () and not task.dtype.is_complex:
            _check_hard_maps(module, image.detach(), query)


def _check_directions(give: Callable[[Directions], Tensor], links: Links, whole: Tensor) -> None:
    """Some of the label's directions have their values in the whole."""
    if links.task.directions is None:
        return
    rays = links.task.directions.flatten()[1::3].to(whole.device)
    rule = "fewer directions must get the same values"
    require_close(give(rays), whole.flatten(1)[:, 1::3], PRECISION[whole.dtype], rule)


def _check_hearing(module: Pooling, twin: Pooling, links: Links, query: Query, dtype: torch.dtype) -> None:
    """What it makes of lags or fields, if it takes them."""
    require(module.takes in (None, "lags", "fields"), f"takes must be lags, fields or None, got {module.takes!r}")
    if module.takes is None:
        return
    task, array = links.task, links.receivers[int(query.receivers[0])].array
    heard = example_fields(module.takes, array, query, task.shape[-1:] or (1,), dtype).requires_grad_()
    value = module.hear(heard, query)
    wanted = dtype.to_complex() if task.dtype.is_complex else dtype
    require_tensor(f"the value of {module.takes}", value, (len(query), *task.shape), wanted, heard.device)
    require(torch.equal(value, module.hear(heard, query)), "what is heard twice must have the same value")
    require(torch.equal(value, twin.hear(heard, query)), "all that it takes in fit must be in the state dict")
    alone = module.hear(heard[-1:], query[-1:])
    require_close(alone, value[-1:], PRECISION[dtype], "a value must not depend on what others hear")
    require_gradients([value], {**dict(module.named_parameters()), module.takes: heard})
    silence = torch.zeros_like(heard).requires_grad_()
    quiet = module.hear(silence, query)
    require(bool(quiet.isfinite().all()), "the value of silence must be finite")
    require_gradients([quiet], {"silence": silence})
    none = module.hear(heard[:0], query[:0])
    require(tuple(none.shape) == (0, *task.shape), f"no {module.takes} must give no values, got {tuple(none.shape)}")
    _check_directions(functools.partial(module.hear, heard, query), links, value)


def example_fields(
    takes: str, array: Array, query: Query, subcarriers: tuple[int, ...], dtype: torch.dtype
) -> Complex[Tensor, "b ..."]:
    """Random fields of an array's elements, or their covariance at the array's lags, as ``aperture`` gives them."""
    generator = torch.Generator().manual_seed(1)
    shape = len(query), len(array), *subcarriers
    fields = torch.randn(*shape, dtype=torch.complex128, generator=generator)
    if takes == "lags":
        covariances = (fields @ fields.mH).flatten(1) / shape[-1]
        _, pairs, counts = array.lags
        fields = covariances.new_zeros(len(query), len(counts)).index_add(1, pairs, covariances) / counts
    return fields.to(query.transmitters.device, dtype.to_complex())


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
