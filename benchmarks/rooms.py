"""One network over several simulated rooms, and what it is worth in a new room with few labels.

    python benchmarks/rooms.py --deformation two_branch basis

Rooms differ in size, materials, furniture and the place of the array, which is the origin of each
room's frame. Tokenizer and deformation are shared by the training rooms; each room has its own
Gaussians, and with ``basis`` its Gaussians' weights. Steps take turns over the rooms. In a new room
all ways train for the same number of steps:

=============  ========================================================================
way            start of the networks
=============  ========================================================================
nothing        random
token          trained over rooms, with the scene token of each room's own Gaussians
no token       trained over rooms, with position embeddings alone
=============  ========================================================================

With ``--frozen`` the networks stay as the training rooms left them, and the new room trains its own
Gaussians and weights. Prints the median SSIM of the held-out labels of each new room: its
mean over seeds and rooms, and with its standard error the mean gain on ``nothing``.
"""

import argparse
import math
import statistics
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from itertools import product

import torch
from jaxtyping import Float
from torch import Tensor, nn

from gaigs.core.geometry import Pose
from gaigs.data import Links, Split
from gaigs.data.simulation import SimulatedRoom, draw_places, simulate_spectra
from gaigs.data.synthetic import POSE, edges, respond_in_parts
from gaigs.data.synthetic.image_source import MATERIALS, Box, Room, frequency_offsets, is_free
from gaigs.model import Model
from gaigs.registry import registry
from gaigs.report.table import markdown
from gaigs.training import seeded
from gaigs.training.schedule import make_optimizer, make_schedule

TEST = 60
"""Held-out places of each room."""

WAYS = {"nothing": "multiview", "token": "multiview", "no token": "euclidean"}
"""Tokenizer of each way."""


def draw_room(seed: int) -> tuple[Room, Float[Tensor, "3"]]:
    """A furnished room, and the place of the array high in the corner at its origin [m]."""
    generator = torch.Generator().manual_seed(seed)

    def draw(low: float, high: float) -> float:
        return low + (high - low) * torch.rand((), generator=generator).item()

    size = draw(4.5, 9.0), draw(3.5, 7.0), draw(2.6, 3.4)
    names = [*MATERIALS]
    picks = torch.randint(len(names), (6,), generator=generator).tolist()
    furniture = []
    for piece in range(3 + picks[0] % 4):
        lower = draw(0.8, size[0] - 1.2), draw(0.8, size[1] - 1.2), 0.0
        upper = lower[0] + draw(0.1, 1.2), lower[1] + draw(0.1, 1.2), draw(0.7, 2.2)
        furniture.append(Box(f"piece{piece}", lower, upper, loss_db=draw(6, 40)))
    room = Room(size, tuple(names[pick] for pick in picks), tuple(furniture))
    return room, torch.tensor([draw(0.15, 0.5), draw(0.15, 0.5), draw(2.0, 2.5)])


def simulate(seed: int, places: int) -> Links:
    """Spectra of random places in a random room, in a frame whose origin is the array."""
    room, position = draw_room(seed)
    upper = torch.tensor(room.size) - 0.3

    def place(count: int, seed: int) -> Tensor:
        lower = torch.full((3,), 0.3)
        return draw_places(
            lower, upper.clamp(max=torch.tensor([9, 9, 2.0])), partial(is_free, room), count, seed
        )

    simulated = SimulatedRoom(
        poses=(Pose(position, POSE.rotation),),
        gateways=(),
        edges=edges(room),
        place=place,
        frequency_offsets=lambda width: frequency_offsets(room, width, 2),
        respond=partial(respond_in_parts, room, order=2),
    )
    links = simulate_spectra(simulated, "band", places, 6.4896e9, 499.2e6, seed)
    receiver = replace(links.receivers[0], pose=Pose(torch.zeros(3), POSE.rotation))
    moved = replace(links.query, transmitters=links.query.transmitters - position)
    return replace(links, query=moved, receivers=(receiver,))


def split(links: Links, count: int, seed: int) -> Links:
    """Links with ``count`` random training places; the last ``TEST`` are held out."""
    pool = len(links) - TEST
    train = torch.randperm(pool, generator=torch.Generator().manual_seed(seed))[:count]
    test = torch.arange(pool, len(links))
    return replace(links, split=Split("rooms", train.sort().values, test[:0], test))


def build(links: Links, deformation: str, tokenizer: str, options: argparse.Namespace) -> Model:
    """A model of a room; scale and octaves are the same for all rooms."""
    reach = torch.full((3,), 9.0)  # [m], of the largest room
    scene = replace(links.scene, lower=-reach, upper=reach)
    embedding = {"name": "euclidean", "transmitter_octaves": options.octaves}
    tokens = embedding | {"name": tokenizer}
    if tokenizer == "multiview":
        tokens = {"name": tokenizer, "euclidean": embedding}
    config = {
        "name": "gaigs",
        "tokenizer": tokens,
        "deformation": {"name": deformation, "width": options.width},
        "gaussians": {"count": options.gaussians},
    }
    return registry("model").build(config, scene=scene)


def share(model: Model, source: Model) -> None:
    """Gives a model the modules within another's tokenizer and deformation; their own parameters,
    such as the weights of ``basis``, stay.
    """
    for name in ("tokenizer", "deformation"):
        part, shared = getattr(model, name), getattr(source, name)
        for child, module in shared.named_children():
            setattr(part, child, module)


def networks(model: Model) -> list[nn.Parameter]:
    """Parameters that ``share`` gives."""
    modules = [*model.tokenizer.children(), *model.deformation.children()]
    return [*nn.ModuleList(modules).parameters()]


def train(rooms: Sequence[tuple[Model, Links]], steps: int, rate: float, seed: int) -> None:
    """Trains models in turns, a step a room; ``rate`` is that of the networks."""
    shared = networks(rooms[0][0])
    known = {id(parameter) for parameter in shared}
    groups = {"shared": [parameter for parameter in shared if parameter.requires_grad]}
    usual = rooms[0][0].learning_rates
    rates = {"shared": rate}
    for number, (model, _) in enumerate(rooms):
        for name, parameters in model.parameter_groups().items():
            own = [parameter for parameter in parameters if id(parameter) not in known]
            groups[f"{number} {name}"], rates[f"{number} {name}"] = own, usual[name]
    kept = {name: group for name, group in groups.items() if group}
    optimizer = make_optimizer({"_target_": "torch.optim.AdamW"}, kept, rates)
    schedule = make_schedule({"warmup": 20, "final": 0.03}, optimizer, lambda step: step / steps)
    task = rooms[0][1].task
    loss, thin = registry("loss").build("l1_ssim", task=task), task.thinning(stride=6)
    generator = torch.Generator().manual_seed(seed)
    for step in range(steps):
        model, links = rooms[step % len(rooms)]
        order = torch.randperm(len(links.split.train), generator=generator)[:8]
        batch = thin(links.batch(links.split.train[order]), seeded(seed, step))
        value, penalties = model(batch)
        total = loss(value, batch)[0] + 0.01 * penalties["opacity"]
        optimizer.zero_grad()
        total.backward()
        optimizer.step()
        schedule.step()


@torch.no_grad()
def score(model: Model, links: Links) -> float:
    """Median SSIM of the held-out labels."""
    batch = links.batch(links.split.test)
    return links.task.scores(batch.labels, model.evaluate(batch))["ssim"].median().item()


def adapt(
    source: Model | None, links: Links, way: tuple[str, str], seed: int, options: argparse.Namespace
) -> float:
    """Trains a model of a new room from shared networks or from nothing, and scores it."""
    torch.manual_seed(seed)
    model = build(links, *way, options)
    rate = options.network_rate
    if source is not None:
        start = {id(parameter): parameter for parameter in networks(model)}
        for own, other in zip(start.values(), networks(source), strict=True):
            own.data.copy_(other.data)
            own.requires_grad_(not options.frozen)
        rate = rate * options.adapted
    train([(model, links)], options.steps, rate, seed)
    return score(model, links)


def pretrain(way: tuple[str, str], rooms: Sequence[Links], seed: int, options) -> Model:
    """Networks trained over rooms; prints their mean score there."""
    torch.manual_seed(seed)
    models = [build(links, *way, options) for links in rooms]
    for model in models[1:]:
        share(model, models[0])
    train([*zip(models, rooms, strict=True)], options.shared_steps, options.network_rate, seed)
    scores = [score(model, links) for model, links in zip(models, rooms, strict=True)]
    print("training rooms,", *way, f"seed {seed}: {statistics.mean(scores):.3f}", flush=True)
    return models[0]


def look_ups(links: Links) -> dict[str, float]:
    """Scores of the baselines."""
    scores = {}
    for name in ("mean", "knn"):
        model = registry("model").build(name, scene=links.scene)
        model.fit(links)
        scores[name] = score(model, links)
    return scores


def line(name: str, scores: Sequence[float], reference: Sequence[float]) -> tuple[str, str, str]:
    """A row: mean, and mean gain with its standard error."""
    gains = [own - other for own, other in zip(scores, reference, strict=True)]
    error = statistics.stdev(gains) / math.sqrt(len(gains)) if len(gains) > 1 else math.nan
    gain = f"{statistics.mean(gains):+.3f} ± {error:.3f}"
    return name, f"{statistics.mean(scores):.3f}", "" if scores is reference else gain


def main() -> None:
    shape = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=shape)
    parser.add_argument("--deformation", nargs="+", default=["two_branch"])
    parser.add_argument("--ways", nargs="+", choices=WAYS, default=[*WAYS])
    parser.add_argument("--labels", nargs="+", type=int, default=[10, 30, 100])
    parser.add_argument("--seeds", nargs="+", type=int, default=[0, 1, 2])
    parser.add_argument("--new", nargs="+", type=int, default=[100, 101, 102], help="new rooms")
    parser.add_argument("--rooms", type=int, default=6, help="training rooms, of 200 places each")
    parser.add_argument("--shared-steps", type=int, default=900, help="over all training rooms")
    parser.add_argument("--steps", type=int, default=200, help="in a new room")
    parser.add_argument("--network-rate", type=float, default=1.6e-2, help="0.008 suits basis")
    parser.add_argument("--adapted", type=float, default=0.03, help="rate in a new room over that")
    parser.add_argument("--frozen", action="store_true", help="adapt no network")
    parser.add_argument("--gaussians", type=int, default=100)
    parser.add_argument("--width", type=int, default=64, help="of the networks")
    parser.add_argument("--octaves", type=int, nargs=2, default=[-5, -2], help="of transmitters")
    options = parser.parse_args()
    rooms = [split(simulate(seed, 200 + TEST), 200, 0) for seed in range(options.rooms)]
    new = [simulate(seed, max(options.labels) + TEST) for seed in options.new]
    rows = [("deformation", "labels", "way", "median SSIM", "gain on nothing")]
    for deformation in options.deformation:
        found: dict[tuple[int, str], list[float]] = {}
        for seed in options.seeds:
            sources: dict[str, Model | None] = {"nothing": None}
            for name in options.ways:
                if name != "nothing":
                    sources[name] = pretrain((deformation, WAYS[name]), rooms, seed, options)
            for links, count in product(new, options.labels):
                own = split(links, count, seed)
                scores = look_ups(own)
                for name in options.ways:
                    way = deformation, WAYS[name]
                    scores[name] = adapt(sources[name], own, way, seed, options)
                for name, value in scores.items():
                    found.setdefault((count, name), []).append(value)
                values = ", ".join(f"{name} {value:.3f}" for name, value in scores.items())
                print(f"{deformation}, seed {seed}, {count} labels: {values}", flush=True)
        for (count, name), scores in sorted(found.items(), key=lambda item: item[0][0]):
            cells = line(name, scores, found.get((count, "nothing"), scores))
            rows.append((deformation, str(count), *cells))
    print(markdown(rows))


if __name__ == "__main__":
    main()
