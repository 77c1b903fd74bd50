"""Checks of each kind's contract, for the tests of whoever writes a component.

>>> from gaigs.registry import registry
>>> check_projection(registry("projection").build({"name": "mercator"}, pixel=0.02))

A check raises ``AssertionError``, which says what must hold, and returns nothing where all of it does.
"""

import copy
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from gaigs.data import Grid, Links, Receiver, Scene, Split
from gaigs.geometry import Pose, from_spherical, quaternions_to_rotations
from gaigs.model import Model
from gaigs.projection import NEAR, Plane, Projection, Splats
from gaigs.rasterizer import ALPHA_MAX, ALPHA_MIN, Rasterizer
from gaigs.training.batches import take

PRECISION = {torch.float32: 1e-4, torch.float64: 1e-9}
"""How far a result may be from the truth, of the largest true value."""


def example_links() -> Links:
    """A made-up data set: 24 links to two turned receivers, random spectra of 18 x 36 pixels."""
    generator = torch.Generator().manual_seed(0)
    grid = Grid.degrees(range(4, 90, 5), range(0, 360, 10))
    poses = Pose.from_xyzw((0.2, 0.2, 2.5), (-0.6, 0, 0, 0.8)), Pose.from_xyzw((5.0, 4.0, 1.0), (0, 0.6, 0.8, 0))
    return Links(
        transmitters=torch.rand(24, 3, generator=generator) * torch.tensor([6.0, 4.0, 2.0]),
        receivers=tuple(Receiver(f"gateway{i}", pose) for i, pose in enumerate(poses)),
        receiver_index=torch.arange(24) % 2,
        labels=torch.rand(24, *grid.shape, generator=generator),
        split=Split("example", *torch.arange(24).split((16, 4, 4))),
        grid=grid,
        normalisation="none",
    )


def check_data(links: Links) -> None:
    """Links that a data set's reader gives: shapes, ranges, a split without overlap, a scene that can be stored.

    Raises:
        AssertionError: The links break the contract of ``gaigs.data.Links``.
    """
    n = len(links.transmitters)
    _check_tensor("transmitters", links.transmitters, (n, 3), torch.float32)
    _check_tensor("edges", links.edges, (len(links.edges), 2, 3), torch.float32)
    index = links.receiver_index
    _require(
        tuple(index.shape) == (n,) and index.dtype == torch.long, "receiver_index must hold an integer for each link"
    )
    _require(
        bool(index.lt(len(links.receivers)).all() and index.ge(0).all()), "receiver_index must point into receivers"
    )
    for receiver in links.receivers:
        turn = receiver.pose.rotation
        _close(turn.mT @ turn, torch.eye(3), 1e-5, f"the rotation of {receiver.name} must be orthonormal")
        _require(bool(turn.det() > 0), f"the rotation of {receiver.name} must not mirror")

    parts = links.split.parts()
    together = torch.cat([*parts.values()])
    _require(len(together.unique()) == len(together), "no link may stand twice in train, validation and test")
    _require(bool(together.lt(n).all() and together.ge(0).all()), f"the split must point at the {n} links")
    _require(len(parts["train"]) and len(parts["test"]), "the split must leave links to train and to test on")

    some = torch.cat([part[:3] for part in parts.values()]).flip(0)
    labels = links.labels[some]
    _check_tensor("labels", labels, (len(some), *(() if links.grid is None else links.grid.shape)), torch.float32)
    _require(torch.equal(labels, links.labels[some]), "labels asked for twice must be the same")
    _require(torch.equal(labels[-1:], links.labels[some[-1:]]), "a label must not depend on which others are asked for")
    if links.grid is not None:
        _require(bool(labels.ge(0).all() and labels.le(1).all()), "spectra must lie in [0, 1]")
        _require(bool(links.grid.elevations.abs().max() <= math.pi / 2 + 1e-6), "elevations must be in radians")
    state = links.scene.state()
    again = Scene.from_state(state).state()
    _require(_flat(state) == _flat(again), "the scene must come back from its state as it was")


def check_tokenizer(tokenizer: nn.Module, scene: Scene, device: torch.device | str = "cpu") -> None:
    """A tokenizer built for the scene: widths, dtype, gradients, independence of the batch.

    Raises:
        AssertionError: It breaks the contract of ``gaigs.tokenizer.Tokens``.
    """
    names = ("scene", "gaussians", "transmitters")
    widths = tokenizer.scene_width, tokenizer.gaussian_width, tokenizer.transmitter_width
    generator = torch.Generator().manual_seed(0)
    for n, b, dtype in ((40, 3, torch.float32), (1, 1, torch.float32), (40, 3, torch.float64)):
        module = copy.deepcopy(tokenizer).to(device, dtype).eval()
        means, transmitters = (
            torch.lerp(scene.lower, scene.upper, torch.rand(count, 3, generator=generator)).to(device, dtype)
            for count in (n, b)
        )
        opacities = torch.rand(n, generator=generator).to(device, dtype)
        transmitters.requires_grad_()
        tokens = module(means, opacities, transmitters)
        shapes = (b, widths[0]), (n, widths[1]), (b, widths[2])
        for name, token, shape in zip(names, tokens, shapes, strict=True):
            _check_tensor(f"the token {name}", token, shape, dtype, device)
        again = module(means, opacities, transmitters)
        _require(all(map(torch.equal, tokens, again)), "two calls must give the same tokens")
        alone = module(means, opacities, transmitters[-1:])
        for name, token, single in zip(names, tokens, alone, strict=True):
            expected = token if name == "gaussians" else token[-1:]
            _close(single, expected, PRECISION[dtype], f"the token {name} must not depend on the other transmitters")
        _check_gradients(tokens, {**dict(module.named_parameters()), "transmitters": transmitters})
        heard = torch.cat((tokens.scene, tokens.transmitters), -1)
        if b > 1 and heard.shape[1]:
            apart = (heard[0] - heard[1]).abs().max() > PRECISION[dtype] * heard.abs().max()
            _require(bool(apart), "tokens must tell two transmitters apart")


def check_projection(projection: Projection, device: torch.device | str = "cpu") -> None:
    """A projection: ``jacobian`` and ``plane`` agree with ``coordinates``; nothing breaks at pole, horizon and seam.

    Raises:
        AssertionError: It breaks the contract of ``gaigs.projection.Projection``.
    """
    degrees = lambda *range_: torch.arange(*range_, dtype=torch.float64, device=device).deg2rad()
    azimuths, elevations = torch.cartesian_prod(degrees(-175, 180, 25), degrees(-55, 60, 10)).unbind(1)
    directions = from_spherical(azimuths, elevations)
    points = 3 * directions
    coordinates = projection.coordinates(points)
    _check_tensor("coordinates", coordinates, (len(points), 2), torch.float64, device)
    _close(projection.coordinates(directions), coordinates, 1e-12, "coordinates must not depend on the distance")
    _close(projection.coordinates(points[:1]), coordinates[:1], 1e-12, "coordinates must not depend on other points")
    jacobian = projection.jacobian(points)
    _check_tensor("the jacobian", jacobian, (len(points), 2, 3), torch.float64, device)
    derivative = torch.autograd.functional.jacobian(lambda p: projection.coordinates(p).sum(0), points).transpose(0, 1)
    _close(jacobian, derivative, 1e-9, "jacobian must be the derivative of coordinates")
    _check_tensor("the jacobian of float32 points", projection.jacobian(points.float()), jacobian.shape, torch.float32)

    for elevations, azimuths in ((degrees(-80, 81, 20), degrees(0, 360, 30)), (degrees(30, 31), degrees(350, 351))):
        _check_plane(projection, elevations, azimuths)
    _check_footprints(projection, device)

    turn = quaternions_to_rotations(torch.tensor([0.4, -0.2, 0.7, 0.1], dtype=torch.float64, device=device))
    receiver = Pose(torch.tensor([1.0, -2.0, 0.5], dtype=torch.float64, device=device), turn)
    covariances = torch.diag(torch.tensor([0.01, 0.02, 0.05], dtype=torch.float64, device=device))
    here = projection.project(points, covariances.expand(1, len(points), 3, 3), Pose(torch.zeros(3), torch.eye(3)))
    turned = (turn @ covariances @ turn.mT).expand(1, len(points), 3, 3)
    there = projection.project(receiver.world(points), turned, receiver)
    for name in ("means2d", "covariances2d", "depths"):
        _close(getattr(there, name), getattr(here, name), 1e-9, f"{name} must be those in the receiver's own frame")


def check_rasterizer(rasterizer: Rasterizer, device: torch.device | str = "cpu") -> None:
    """A rasterizer: map, transmittance and gradients against ``rasterize_densely``, on easy scenes and hard ones.

    float64 may be refused by a ``TypeError``.

    Raises:
        AssertionError: It breaks the contract of ``gaigs.rasterizer.Rasterizer``.
    """
    for title, arguments in _scenes():
        # Where A meets one of its bounds to within rounding, the two may rightly decide differently.
        away = _distance_to_jumps(*arguments) > 1e-4
        truth = _render(rasterize_densely, _cast(arguments, "cpu", torch.float64), away)
        for dtype, tolerance in PRECISION.items():
            moved = _cast(arguments, device, dtype)
            try:
                found = _render(rasterizer, moved, away.to(device))
            except TypeError:
                _require(dtype != torch.float32, "float32 must be supported")
                continue
            for name, true in truth.items():
                _check_tensor(f"{title}: {name}", found[name], true.shape, dtype, device)
                _close(found[name].cpu(), true, tolerance, f"{title}: {name} must be that of the formula")
            again = _render(rasterizer, moved, away.to(device))
            for name in ("map", "transmittance"):
                _require(torch.equal(found[name], again[name]), f"{title}: two runs must give the same {name}")
            alone = _render(rasterizer, _only_last(moved), away[-1:].to(device))
            _close(alone["map"], found["map"][-1:], tolerance, f"{title}: a map must not depend on other transmitters")
    _check_nan_shows(rasterizer, device)


def check_pooling(build: Callable[[Grid], nn.Module], device: torch.device | str = "cpu") -> None:
    """A pooling: a label for each map, gradients finite even where the map is 0, independence of the batch.

    One that gives RSSI (b,) must also take maps that are constant, span 12 decades or are of half precision.

    Args:
        build: Makes the pooling for a grid.
        device: Where it works.

    Raises:
        AssertionError: It breaks the contract of kind ``pooling``.
    """
    generator = torch.Generator().manual_seed(0)
    pixel = Grid(torch.tensor([0.3]), torch.tensor([0.5]))
    cases = (3, Grid.sphere(5, 8), torch.float32), (1, pixel, torch.float32), (3, Grid.sphere(5, 8), torch.float64)
    for b, grid, dtype in cases:
        module = build(grid).to(device, dtype).eval()
        channels = module.channels
        _require(isinstance(channels, int) and channels > 0, f"channels must be how many it needs, got {channels!r}")
        image = torch.randn(b, channels, *grid.shape, generator=generator).to(device, dtype).requires_grad_()
        label = module(image)
        _check_tensor("the label", label, (b,) if label.ndim == 1 else (b, *grid.shape), dtype, device)
        _require(torch.equal(label, module(image)), "two calls must give the same label")
        _close(module(image[-1:]), label[-1:], PRECISION[dtype], "a label must not depend on the other maps")
        _check_gradients([label], {**dict(module.named_parameters()), "the map": image})
        silence = torch.zeros_like(image).requires_grad_()
        _check_gradients([module(silence)], {"a silent map": silence})
        if label.ndim == 1:
            _check_hard_maps(module, image.detach())


def check_model(build: Callable[[Scene], Model], links: Links, device: torch.device | str = "cpu") -> None:
    """A model: it fits, predicts, trains and can be stored.

    Args:
        build: Makes the model for a scene.
        links: What it is fitted to.
        device: Where it works.

    Raises:
        AssertionError: It breaks the contract of ``gaigs.model.Model``.
    """
    model = build(links.scene).to(device)
    model.fit(links)
    index = torch.cat((links.split.train, links.split.test))
    batch = take(links, index[links.receiver_index[index] == links.receiver_index[index[0]]][:5]).to(device)
    receiver = links.receivers[batch.receivers[0]].pose.position
    asked = torch.cat((batch.transmitters.cpu(), receiver[None], receiver[None] + 1e3))
    receiver = int(batch.receivers[0])
    labels = model.train().predict(asked, receiver)
    _require(model.training, "predict must leave the model in the mode it was in")
    _check_tensor("predictions", labels, (len(asked), *batch.labels.shape[1:]), torch.float32)
    _require(not labels.requires_grad, "predictions must not carry a gradient")
    _require(torch.equal(labels, model.predict(asked, receiver)), "two calls must give the same predictions")
    _close(
        model.predict(asked, receiver, batch_size=1), labels, 1e-4, "the batch size must not change predictions"
    )
    _require(len(model.predict(asked[:0], receiver)) == 0, "no transmitters must give no predictions")
    grid = model.predict(asked.expand(2, *asked.shape), receiver)
    _close(grid, labels.expand(2, *labels.shape), 1e-4, "a grid of positions must give a grid of predictions")
    wrong = {"two coordinates": asked[:, :2], "NaN": asked * torch.nan}
    for what, transmitters in wrong.items():
        _raises(ValueError, lambda t=transmitters: model.predict(t), f"transmitters with {what} must be a ValueError")
    for number in (-1, len(links.receivers)):
        _raises(ValueError, lambda i=number: model.predict(asked, i), f"receiver {number} must be a ValueError")

    parameters = dict(model.named_parameters())
    grouped = [id(parameter) for group in model.parameter_groups().values() for parameter in group]
    _require(
        sorted(grouped) == sorted(map(id, parameters.values())), "each parameter must stand in one of parameter_groups"
    )
    if not parameters:
        return
    mixed = take(links, index[:8]).to(device)
    each = torch.cat([model(take(links, index[i : i + 1]).to(device)).label for i in range(len(index[:8]))])
    _close(model(mixed).label, each, 1e-4, "links to several receivers must come out as each by itself")
    prediction = model(batch)
    _check_tensor("the label", prediction.label, batch.labels.shape, torch.float32, device)
    for name, penalty in prediction.penalties.items():
        _check_tensor(f"the penalty {name}", penalty, (), torch.float32, device)
    _check_gradients([prediction.label, *prediction.penalties.values()], parameters)
    if batch.grid is not None:
        rows, columns = slice(1, None, 3), slice(2, None, 4)
        thin = model(batch.thin(rows, columns)).label
        _close(thin, prediction.label[:, rows, columns], 1e-4, "fewer directions must get the same values")
    twin = build(Scene.from_state(links.scene.state())).to(device)
    twin.load_state_dict(model.state_dict())
    twice = twin.train().predict(asked, receiver)
    _require(torch.equal(labels, twice), "all that predict needs must be in the state dict")


def rasterize_densely(
    splats: Splats,
    signal: Float[Tensor, "b n c"],
    opacities: Float[Tensor, "b n"],
    attenuations: Float[Tensor, "b n"] | None,
    plane: Plane,
) -> tuple[Float[Tensor, "b c rows columns"], Float[Tensor, "b rows columns"]]:
    """The formula of ``gaigs.rasterizer.Rasterizer`` over all pairs of splat and pixel, in float64: slow, but plain."""
    order, footprints = _footprints(splats, plane)
    product = opacities[:, order, None, None].double() * footprints
    acts = product >= ALPHA_MIN
    alpha = torch.where(acts, product.clamp(max=ALPHA_MAX), 0)
    passed = 1 - alpha
    if attenuations is not None:
        passed = passed * torch.where(acts, attenuations[:, order, None, None].double() ** footprints, 1)
    reached = torch.cat((torch.ones_like(passed[:, :1]), passed), 1).cumprod(1) if len(order) else passed
    image = torch.einsum("bnc,bnrs->bcrs", signal[:, order].double(), alpha * reached[:, : len(order)])
    return image, passed.prod(1)


def _footprints(splats: Splats, plane: Plane) -> tuple[Tensor, Float[Tensor, "b n rows columns"]]:
    """Indices of visible splats front to back, and exp(-x' C^-1 x / 2) of each at every pixel, float64."""
    order = splats.depths.argsort(stable=True)
    order = order[splats.visible[order]]
    u, v = splats.means2d[order].double()[..., None, None].unbind(1)
    du, dv = plane.u.double() - u, plane.v.double() - v
    if plane.period is not None:
        du = torch.remainder(du + plane.period / 2, plane.period) - plane.period / 2
    x = torch.stack(torch.broadcast_tensors(du, dv), -1)
    precisions = torch.linalg.inv(splats.covariances2d[:, order].double())
    return order, torch.exp(-0.5 * torch.einsum("nrsi,bnij,nrsj->bnrs", x, precisions, x))


@torch.no_grad()
def _distance_to_jumps(splats, signal, opacities, attenuations, plane) -> Float[Tensor, "b rows columns"]:
    """How far, relatively, each pixel is from the nearest jump of value or gradient, a G = ALPHA_MIN or ALPHA_MAX."""
    order, footprints = _footprints(splats, plane)
    product = opacities[:, order, None, None].double() * footprints
    bounds = product.new_tensor([ALPHA_MIN, ALPHA_MAX])[:, None, None, None, None]
    distances = (product / bounds - 1).abs().amin(0)
    return torch.cat((distances, torch.full_like(product.sum(1, keepdim=True), torch.inf)), 1).amin(1)


def _scenes() -> Iterator[tuple[str, tuple]]:
    """Arguments of a rasterizer, each with a title."""
    generator = torch.Generator().manual_seed(0)
    azimuths, elevations = torch.arange(-180.0, 180, 9).deg2rad()[None], torch.linspace(0.02, 1.5, 21)[:, None]
    cylinder = Plane(azimuths, elevations, 2 * math.pi)

    def scene(n=50, b=2, c=2, own=False, attenuations=False, plane=cylinder, spread=(0.05, 0.6), opacity=(0, 0.99)):
        random = lambda low, high, *shape: low + (high - low) * torch.rand(*shape, generator=generator)
        low, high = (torch.stack([getattr(axis, end)() for axis in (plane.u, plane.v)]) for end in ("min", "max"))
        turns = random(0, math.pi, b if own else 1, n)
        axes = torch.stack((turns.cos(), -turns.sin(), turns.sin(), turns.cos()), -1).unflatten(-1, (2, 2))
        half = axes * random(math.log(spread[0]), math.log(spread[1]), len(turns), n, 2).exp()[..., None, :]
        splats = Splats(random(low, high, n, 2), half @ half.mT, random(0.5, 5, n), random(0, 1, n) > 0.1)
        signal = torch.randn(b, n, c, generator=generator)
        return splats, signal, random(*opacity, b, n), random(0.3, 1, b, n) if attenuations else None, plane

    yield "random", scene()
    yield "attenuations", scene(attenuations=True)
    yield "own covariances", scene(own=True, attenuations=True)
    yield "one channel", scene(c=1)
    yield "no splat", scene(n=0)
    yield "one splat, one transmitter", scene(n=1, b=1)
    yield "opaque", scene(opacity=(1, 1), spread=(0.2, 1))
    yield "silent", scene(opacity=(0, 0))
    yield "wider than the plane", scene(n=12, spread=(5, 20))
    yield "narrower than a pixel", scene(spread=(0.01, 0.02), opacity=(0.9, 1))
    yield "one pixel", scene(plane=Plane(azimuths[:, :1], elevations[:1], 2 * math.pi), spread=(0.5, 1))
    yield "one row", scene(plane=Plane(azimuths, elevations[:1], 2 * math.pi))
    yield "one column", scene(plane=Plane(azimuths[:, :1], elevations, 2 * math.pi))
    disc = elevations.cos() * azimuths.cos(), elevations.cos() * azimuths.sin()
    yield "rows and columns mixed", scene(plane=Plane(*disc, None), own=True, attenuations=True)
    yield "columns mixed", scene(plane=Plane(azimuths * elevations.cos(), elevations, None))
    splats, *rest = scene()
    splats.depths.round_()
    yield "equal depths", (splats, *rest)
    splats, *rest = scene()
    splats.covariances2d[:, ~splats.visible], splats.means2d[~splats.visible] = torch.nan, torch.inf
    yield "rubbish that is not visible", (splats, *rest)


def _render(rasterizer: Rasterizer, arguments: tuple, pixels: Bool[Tensor, "b rows columns"]) -> dict[str, Tensor]:
    """Map and transmittance at ``pixels``, and the gradients of a fixed function of both."""
    splats, signal, opacities, attenuations, plane = arguments
    leaves = {"means2d": splats.means2d, "covariances2d": splats.covariances2d}
    leaves |= {"signal": signal, "opacities": opacities, "attenuations": attenuations}
    leaves = {name: None if leaf is None else leaf.detach().clone().requires_grad_() for name, leaf in leaves.items()}
    means2d, covariances2d, *others = leaves.values()
    image, left = rasterizer(replace(splats, means2d=means2d, covariances2d=covariances2d), *others, plane)
    image, left = image * pixels[:, None], left * pixels
    (_fixed_sum(image) + _fixed_sum(left)).backward()
    results = {"map": image.detach(), "transmittance": left.detach()}
    for name, leaf in leaves.items():
        if leaf is not None:
            gradient = torch.zeros_like(leaf) if leaf.grad is None else leaf.grad
            # A covariance is symmetric: how its gradient is shared between [0, 1] and [1, 0] does not matter.
            results[f"gradient of {name}"] = (gradient + gradient.mT) / 2 if name == "covariances2d" else gradient
    return results


def _cast(arguments: tuple, device: torch.device | str, dtype: torch.dtype) -> tuple:
    splats, signal, opacities, attenuations, plane = arguments
    to = lambda tensor: None if tensor is None else tensor.to(device, dtype)
    splats = Splats(*map(to, (splats.means2d, splats.covariances2d, splats.depths)), splats.visible.to(device))
    return splats, to(signal), to(opacities), to(attenuations), Plane(to(plane.u), to(plane.v), plane.period)


def _only_last(arguments: tuple) -> tuple:
    """The last transmitter by itself."""
    splats, signal, opacities, attenuations, plane = arguments
    splats = replace(splats, covariances2d=splats.covariances2d[-1:])
    return splats, signal[-1:], opacities[-1:], None if attenuations is None else attenuations[-1:], plane


def _check_nan_shows(rasterizer: Rasterizer, device: torch.device | str) -> None:
    """What is broken must not vanish."""
    for name in ("means2d", "covariances2d", "signal", "opacities"):
        splats, signal, opacities, attenuations, plane = _cast(next(_scenes())[1], device, torch.float32)
        broken = {"means2d": splats.means2d[None], "covariances2d": splats.covariances2d, "signal": signal}
        front = torch.where(splats.visible, splats.depths, torch.inf).argmin()
        broken.get(name, opacities)[:, front] = torch.nan
        image, _ = rasterizer(splats, signal, opacities, attenuations, plane)
        _require(bool(image.isnan().any()), f"NaN in {name} must show as NaN in the map")


def _check_plane(projection: Projection, elevations: Tensor, azimuths: Tensor) -> None:
    rows, columns = len(elevations), len(azimuths)
    plane = projection.plane(elevations, azimuths)
    _require(
        plane.u.shape in ((1, columns), (rows, columns)),
        f"plane.u must be (1 or {rows}, {columns}), got {plane.u.shape}",
    )
    _require(
        plane.v.shape in ((rows, 1), (rows, columns)), f"plane.v must be ({rows}, 1 or {columns}), got {plane.v.shape}"
    )
    u, v = projection.coordinates(from_spherical(*torch.meshgrid(azimuths, elevations, indexing="xy"))).unbind(-1)
    off = plane.u - u
    if plane.period is not None:
        off = off - plane.period * (off / plane.period).round()
    _close(off, torch.zeros_like(off), 1e-9, "plane.u must be coordinates' u at the pixels' directions")
    _close(plane.v.expand_as(v), v, 1e-9, "plane.v must be coordinates' v at the pixels' directions")


def _check_footprints(projection: Projection, device: torch.device | str) -> None:
    """Values and gradients at hard places, among them the receiver's own."""
    places = [(0, 0, 3), (0, 0, -3), (1e-5, 0, 3), (3, 0, 0), (-3, 0, 0), (-3, -1e-6, 0), (0, -3, 0)]
    places += [(3 * NEAR, 0, 4 * NEAR), (-3e4, 2e4, 1e4), (0, 0, 0)]
    identity = Pose(torch.zeros(3), torch.eye(3))
    for dtype in (torch.float64, torch.float32):
        means = torch.tensor(places, dtype=dtype, device=device).requires_grad_()
        covariances = (0.01 * torch.eye(3, dtype=dtype, device=device)).repeat(2, len(places), 1, 1).requires_grad_()
        splats = projection.project(means, covariances, identity)
        shapes = {"means2d": (len(places), 2), "covariances2d": (2, len(places), 2, 2), "depths": (len(places),)}
        for name, shape in shapes.items():
            _check_tensor(f"{name} at hard places", getattr(splats, name), shape, dtype, device)
        _require(
            splats.visible.tolist() == [True] * (len(places) - 1) + [False], "only what sits on the receiver is hidden"
        )
        _close(splats.depths, means.norm(dim=-1), 1e-5, "depths must be distances to the receiver")
        _check_gradients([splats.means2d, splats.covariances2d], {"means": means, "covariances": covariances})
        if dtype == torch.float64:
            smallest = torch.linalg.eigvalsh(splats.covariances2d)[..., 0]
            _require(bool(smallest.gt(0).all()), "covariances2d must be positive definite")
        shared = projection.project(means, covariances[:1], identity).covariances2d
        _close(shared, splats.covariances2d[:1], 1e-6, "covariances2d must not depend on the other transmitters")


def _check_hard_maps(pooling: nn.Module, image: Float[Tensor, "b c rows columns"]) -> None:
    """RSSI and its gradients are finite; float32 where the map is of half precision, whose steps are 0.06 dB."""
    decades = torch.linspace(-6, 6, image[0].numel()).reshape(image.shape[1:]).to(image)
    maps = {"a silent map": 0 * image, "a constant map": torch.ones_like(image), "12 decades": 10**decades * image}
    if image.dtype == torch.float32:
        maps |= {f"{name} in float16": m.clamp(-6e4, 6e4).half() for name, m in maps.items()}
    for name, leaf in maps.items():
        leaf.requires_grad_()
        label = pooling(leaf)
        dtype = torch.float32 if leaf.dtype == torch.half else leaf.dtype
        _require(label.dtype == dtype, f"the label of {name} must be {dtype}, got {label.dtype}")
        _require(bool(label.isfinite().all()), f"the label of {name} must be finite")
        _check_gradients([label], {**dict(pooling.named_parameters()), name: leaf})


def _check_gradients(outputs: Sequence[Tensor], leaves: dict[str, Tensor]) -> None:
    """All gradients of a fixed function of the outputs exist where they can, and are finite."""
    outputs = [output for output in outputs if output.requires_grad and output.numel()]
    if not outputs:
        return
    total = sum(map(_fixed_sum, outputs))
    gradients = torch.autograd.grad(total, [*leaves.values()], allow_unused=True, retain_graph=True)
    for name, gradient in zip(leaves, gradients, strict=True):
        _require(gradient is None or bool(gradient.isfinite().all()), f"the gradient of {name} must be finite")


def _fixed_sum(values: Tensor) -> Tensor:
    """A sum with weights that differ but are always the same, so that no two gradients cancel."""
    weights = torch.arange(values.numel(), device=values.device).cos().to(values)
    return (values.flatten() * weights).sum()


def _check_tensor(
    name: str, tensor: Tensor, shape: Sequence[int], dtype: torch.dtype, device: torch.device | str | None = None
) -> None:
    _require(tuple(tensor.shape) == tuple(shape), f"{name} must be of shape {tuple(shape)}, got {tuple(tensor.shape)}")
    _require(tensor.dtype == dtype, f"{name} must be {dtype} as its input, got {tensor.dtype}")
    same = device is None or tensor.device.type == torch.device(device).type
    _require(same, f"{name} must be on {device} as its input, got {tensor.device}")
    _require(bool(tensor.isfinite().all()), f"{name} must be finite")


def _close(actual: Tensor, expected: Tensor, tolerance: float, rule: str) -> None:
    """Equal to within a fraction of the largest expected value, or of 1 where that is smaller."""
    largest = max(1.0, expected.abs().max().item()) if expected.numel() else 1.0
    torch.testing.assert_close(
        actual.double(), expected.double(), rtol=0, atol=tolerance * largest, msg=lambda detail: f"{rule}\n{detail}"
    )


def _raises(error: type[Exception], call: Callable, rule: str) -> None:
    try:
        call()
    except error:
        return
    raise AssertionError(rule)


def _require(holds: bool, rule: str) -> None:
    if not holds:
        raise AssertionError(rule)


def _flat(state: object) -> list:
    """Tensors and all else in nested lists and dicts, one after another, comparable."""
    if isinstance(state, Tensor):
        return [str(state.dtype), state.tolist()]
    if isinstance(state, dict | list | tuple):
        return [x for part in (state.values() if isinstance(state, dict) else state) for x in _flat(part)]
    return [state]
