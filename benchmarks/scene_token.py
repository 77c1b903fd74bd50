"""Probes of the scene token of GAI-GS, and trainings of several ways to use it.

    python benchmarks/scene_token.py probe RUN python benchmarks/scene_token.py train multiview
    scene_alone own_tokens trainer.max_steps=300 gaussians.count=100

``probe`` looks into a run of ``+experiment=spectrum`` with any of the three tokenizers. ``train``
trains ways of using the token side by side, with overrides of ``python -m gaigs
+experiment=spectrum``. Scores are of the validation links; the test links are not looked at.

=================  =================================================================================================
way                input of the network
=================  =================================================================================================
static             nothing: every transmitter excites the Gaussians alike
euclidean          E(P_x), E(P_TX)
multiview          E(P_x), E(P_TX), CLS: the paper's
ga                 CLS
scene_alone        E(P_x), CLS: the token in place of the transmitter's embedding
own_tokens         a token of each Gaussian, by attention of the transmitter and all Gaussians, and CLS
loud               as multiview, with CLS times 100
loud_alone         as scene_alone, likewise
fixed_alone        as scene_alone, with anchors that are chosen once, evenly among the Gaussians
=================  =================================================================================================
"""

import argparse
import logging
import tempfile
from pathlib import Path

import lightning
import torch
import yaml
from jaxtyping import Float
from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.table import Table
from torch import Tensor, nn

import gaigs
from gaigs.core.query import Query
from gaigs.data import Links, load
from gaigs.model import Model
from gaigs.registry import register, registry
from gaigs.runs.descent import descend
from gaigs.runs.evaluation import validate
from gaigs.splatting.gaussians import Placed, Tokens
from gaigs.splatting.tokenizer.ga import GATokenizer
from gaigs.splatting.tokenizer.multiview import MultiviewTokenizer

GAIN = 100.0
"""By which a faint token is made as loud as E(P_TX) at the start."""

NEIGHBOURS = 3
"""Of a look-up by features, with weights of inverse squared distances."""


@register("tokenizer", "scene_alone")
class SceneAlone(MultiviewTokenizer):
    """The Gaussians' embeddings and the scene token, which alone tells transmitters apart."""

    def __init__(self, scene, ga: dict, euclidean: dict):
        super().__init__(scene, ga, euclidean)
        self.transmitter_width = 0
        self.euclidean.network = nn.Identity()

    def forward(self, placed: Placed, opacities: Float[Tensor, " n"], query: Query) -> Tokens:
        tokens = super().forward(placed, opacities, query)
        return tokens._replace(transmitters=tokens.transmitters[:, :0])


@register("tokenizer", "own_tokens")
class OwnTokens(GATokenizer):
    """All Gaussians among the tokens, and every token read: the paper's naive implementation."""

    def __init__(self, scene, ga: dict, euclidean: dict):
        super().__init__(scene, **{key: value for key, value in ga.items() if key != "name"})
        self.gaussian_width = self.scene_width

    def forward(self, placed: Placed, opacities: Float[Tensor, " n"], query: Query) -> Tokens:
        means, b = placed.means.detach(), len(query)
        n = means.shape[1]
        tx, own = (
            (positions - self.middle) / self.scale for positions in (query.transmitters, means)
        )
        points = self.embed(
            torch.cat((self.cls.expand(b, 1, 3), tx[:, None], own.expand(b, n, 3)), 1)
        )
        types = torch.cat((self.types[:2], self.types[2:].expand(n, 2))).expand(b, -1, -1)
        multivectors, scalars = self.first(points[..., None, :], types)
        for block in self.blocks:
            multivectors, scalars = block(multivectors, scalars, points.mean(1))
        multivectors, scalars = self.last(multivectors, scalars)
        read = self.read_out(torch.cat((multivectors.flatten(2), scalars), -1))
        return Tokens(read[:, 0], read[:, 2:], means.new_zeros(b, 0))


@register("tokenizer", "ga_of_fixed_anchors")
class FixedAnchors(GATokenizer):
    """Anchors evenly among the Gaussians in the order of their start, whatever their opacities."""

    def forward(self, placed: Placed, opacities: Float[Tensor, " n"], query: Query) -> Tokens:
        ranks = torch.zeros_like(opacities)
        ranks[torch.linspace(0, len(ranks) - 1, min(self.anchors, len(ranks))).long()] = 1
        return super().forward(placed, ranks, query)


@register("tokenizer", "ga_loud")
class Loud(GATokenizer):
    """CLS times ``GAIN``."""

    def forward(self, placed: Placed, opacities: Float[Tensor, " n"], query: Query) -> Tokens:
        tokens = super().forward(placed, opacities, query)
        return tokens._replace(scene=GAIN * tokens.scene)


BASE = {
    way: ["deformation=two_branch", f"tokenizer={way}"] for way in ("euclidean", "ga", "multiview")
}
BASE |= {"static": ["deformation=none"]}
"""Overrides of ways; those of ``multiview`` are those of all others. The network is as wide as in
the claims.
"""

NAMES = {name: name for name in ("scene_alone", "own_tokens")}
NAMES |= {"loud": "multiview", "loud_alone": "scene_alone", "fixed_alone": "scene_alone"}
"""The tokenizer of a way, where it is not the one of its configuration."""

GA = {"loud": "ga_loud", "loud_alone": "ga_loud", "fixed_alone": "ga_of_fixed_anchors"}
"""That within it which gives the scene token, likewise."""

WAYS = (*BASE, *NAMES)


def configure(way: str, overrides: list[str]) -> dict:
    """The configuration of a way."""
    config = gaigs.compose("+experiment=spectrum", *BASE.get(way, BASE["multiview"]), *overrides)
    tokenizer = config["model"]["tokenizer"]
    tokenizer["name"] = NAMES.get(way, tokenizer["name"])
    if way in GA:
        tokenizer["ga"]["name"] = GA[way]
    config["trainer"] |= {
        "enable_progress_bar": False,
        "val_check_interval": config["trainer"]["max_steps"],
    }
    return config


def compare(ways: list[str], overrides: list[str]) -> Table:
    """Trains each way for the same steps."""
    titles = (
        "way",
        "mean SSIM",
        "parameters",
        "anchors changed",
        "CLS moves the first layer by",
        "training [s]",
    )
    table = Table(*titles, box=SIMPLE_HEAD)
    for way in ways:
        config = configure(way, overrides)
        lightning.seed_everything(config["seed"], verbose=False)
        links = load(config["data"], config["split"])
        model = registry("model").build(config["model"], scene=links.scene)
        model.fit(links)
        changes = count_changes(model)
        loss = registry("loss").build(config["loss"], task=links.task)
        with tempfile.TemporaryDirectory() as folder:
            model, seconds = descend(model, loss, links, config, Path(folder))
        score = mean_ssim(model, links)
        count = sum(parameter.numel() for parameter in model.parameters())
        shares = changes[1:]
        share = f"{sum(shares) / len(shares):.1%}" if shares else ""
        moved = ""
        if model.tokenizer is not None:
            with torch.no_grad():
                moved = f"{first_layer(model, tokenize(model, links.query))['scene']:.4f}"
        table.add_row(way, f"{score:.3f}", f"{count:,}", share, moved, f"{seconds:.0f}")
        print(way, f"{score:.3f}", flush=True)  # at once, as trainings take minutes
    return table


def count_changes(model: Model) -> list[float]:
    """A list that gets, with each step, the share of anchors that were none in the step before."""
    changes, last = [], set()

    def look(module, arguments):
        nonlocal last
        if module.training:
            opacities = arguments[1]
            now = {*opacities.topk(min(module.anchors, len(opacities))).indices.tolist()}
            changes.append(len(now - last) / len(now))
            last = now

    for module in model.modules():
        if isinstance(module, GATokenizer) and not isinstance(module, OwnTokens | FixedAnchors):
            module.register_forward_pre_hook(look)
    return changes


def mean_ssim(model: Model, links: Links) -> float:
    """Over the validation links."""
    return validate({"model": model}, {}, links)["model"]["ssim"].mean().item()


# --- probes ---


def probe(run: Path) -> Table:
    """Information of the tokens of a trained model on places and labels, and their influence on the
    network.
    """
    config = yaml.safe_load((run / "config.yaml").read_text())
    links = load(config["data"], config["split"])
    torch.manual_seed(config["seed"])
    start = registry("model").build(config["model"], scene=links.scene)
    model = gaigs.load(run / "best.ckpt").eval()
    known, asked = links.split.train, links.split.validation
    places = links.query.transmitters
    with torch.no_grad():
        first, tokens = (tokenize(either, links.query) for either in (start, model))
        moves_then, moves = first_layer(start, first), first_layer(model, tokens)
    gradients = gradient_norms(model, links, config["loss"])
    rows = {key: [] for key in ROWS}
    table = Table("", box=SIMPLE_HEAD)
    for name, field in (("place", None), ("CLS", "scene"), ("E(P_TX)", "transmitters")):
        values = places if field is None else getattr(tokens, field)
        if not values.shape[1]:
            continue
        table.add_column(name, justify="right")
        here, there = values[known], values[asked]
        labels = look_up(here, links.labels[known].flatten(1), there).unflatten(1, links.task.shape)
        texts = [str(values.shape[1]), f"{dimensions(here):.1f}"]
        for predicted in (
            linear_prediction(here, places[known], there),
            look_up(here, places[known], there),
        ):
            texts.append(f"{r_squared(predicted, places[asked], places[known]):.3f}")
        texts.append(
            f"{r_squared(linear_prediction(places[known], here, places[asked]), there, here):.3f}"
        )
        texts.append(f"{ssim(links, labels):.3f}")
        if field is not None:
            texts += [f"{moves_then[field]:.4f}", f"{moves[field]:.4f}", f"{gradients[field]:.1e}"]
            texts.append(f"{without(model, links, field):.3f}")
        if field == "scene":
            texts.append(f"{of_an_anchor(model, links.query[known]):.2f}")
        for row, text in zip(rows.values(), texts + [""] * (len(rows) - len(texts)), strict=True):
            row.append(text)
    for key, row in rows.items():
        table.add_row(key, *row)
    table.caption = f"mean SSIM as it is {mean_ssim(model, links):.3f}; validation links"
    return table


ROWS = (
    "numbers",
    "dimensions: participation ratio of the principal variances",
    "R² of the place, linear",
    "R² of the place, look-up",
    "R² of them from the place, linear",
    "mean SSIM of a look-up of labels",
    "its effect in the network's first layer, RMS, at the start",
    "the same, trained",
    "gradient of a parameter behind it, RMS",
    "mean SSIM of the model without it",
    "its change by another anchor, over its spread over transmitters",
)
"""Rows of ``probe``."""


def ssim(links: Links, labels: Tensor) -> float:
    """Mean of predicted validation labels."""
    return links.task.scores(links.labels[links.split.validation], labels)["ssim"].mean().item()


def tokenize(model: Model, query: Query) -> Tokens:
    """The tokens that a model's network sees."""
    placed = model.placement(model.gaussians, query)
    return model.tokenizer(placed, model.gaussians.opacities, query)


def of_an_anchor(model: Model, query: Query) -> float:
    """Change of the token if the next Gaussian replaces the last anchor, over its RMS spread."""
    ga = getattr(model.tokenizer, "ga", model.tokenizer)
    opacities = model.gaussians.opacities.detach()
    fewer = opacities.clone()
    fewer[opacities.topk(ga.anchors).indices[-1]] = -1
    placed = model.placement(model.gaussians, query)
    with torch.no_grad():
        before, after = (ga(placed, ranks, query).scene for ranks in (opacities, fewer))
    spread = (before - before.mean(0)).square().sum(1).mean().sqrt()
    return ((after - before).square().sum(1).mean().sqrt() / spread).item()


def linear_prediction(features: Tensor, values: Tensor, asked: Tensor) -> Tensor:
    """Least squares with an offset."""

    def ones(x):
        return torch.cat((x, torch.ones_like(x[:, :1])), 1).double()

    return (
        ones(asked) @ torch.linalg.lstsq(ones(features), values.double(), driver="gelsd").solution
    ).float()


def look_up(features: Tensor, values: Tensor, asked: Tensor) -> Tensor:
    """The nearest training links' values, by distance in features scaled to the same variance."""
    scale = features.std(0).clamp(min=1e-9)
    distances, index = torch.cdist(asked / scale, features / scale).topk(NEIGHBOURS, largest=False)
    weights = 1 / distances.square().clamp(min=1e-12)
    return torch.einsum("bk,bkd->bd", weights / weights.sum(1, keepdim=True), values[index])


def r_squared(values: Tensor, truth: Tensor, known: Tensor) -> float:
    """Share of the squared distance from the training links' mean that is explained."""
    return 1 - ((values - truth).square().sum() / (truth - known.mean(0)).square().sum()).item()


def dimensions(features: Tensor) -> float:
    """Participation ratio of the variances along the principal axes."""
    variances = torch.linalg.svdvals(features - features.mean(0)).square()
    return (variances.sum().square() / variances.square().sum()).item()


def first_layer(model: Model, tokens: Tokens) -> dict[str, float]:
    """RMS change by each token in the attenuation branch's first layer, from transmitter to
    transmitter.
    """
    names = ("scene", "transmitters")
    values = [getattr(tokens, name) for name in names]
    parts = model.deformation.attenuation_first.links.weight.split(
        [value.shape[1] for value in values], 1
    )
    moves = [(value - value.mean(0)) @ part.T for value, part in zip(values, parts, strict=True)]
    return {
        name: move.square().mean().sqrt().item() for name, move in zip(names, moves, strict=True)
    }


def gradient_norms(model: Model, links: Links, loss: dict) -> dict[str, float]:
    """Of the loss of 16 training links by the parameters behind each token, a parameter (RMS)."""
    batch = links.batch(links.split.train[:16])
    registry("loss").build(loss, task=links.task)(model(batch).value, batch)[0].backward()
    norms = {}
    for name, part in (("scene", "ga"), ("transmitters", "euclidean")):
        module = getattr(model.tokenizer, part, model.tokenizer)
        gradients = [
            parameter.grad.flatten()
            for parameter in module.parameters()
            if parameter.grad is not None
        ]
        norms[name] = torch.cat(gradients).square().mean().sqrt().item()
    return norms


def without(model: Model, links: Links, name: str) -> float:
    """The score where a token is the mean over the training transmitters for all."""
    with torch.no_grad():
        mean = getattr(tokenize(model, links.query[links.split.train]), name).mean(0)
    hook = model.tokenizer.register_forward_hook(
        lambda module, arguments, tokens: tokens._replace(
            **{name: mean.expand_as(getattr(tokens, name))}
        )
    )
    score = mean_ssim(model, links)
    hook.remove()
    return score


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    commands = parser.add_subparsers(dest="command", required=True)
    commands.add_parser("probe").add_argument("run", type=Path, nargs="+", help="folder of a run")
    commands.add_parser("train").add_argument(
        "words", nargs="+", help=f"of {', '.join(WAYS)}, and KEY=VALUE"
    )
    options = parser.parse_args()
    logging.getLogger("lightning.pytorch").setLevel(logging.ERROR)
    console = Console(width=160)
    if options.command == "train":
        ways = [word for word in options.words if "=" not in word]
        if unknown := {*ways} - {*WAYS}:
            parser.error(f"ways must be among {', '.join(WAYS)}, got {', '.join(sorted(unknown))}")
        console.print(compare(ways, [word for word in options.words if "=" in word]))
        return
    for run in options.run:
        console.print(str(run))
        console.print(probe(run))


if __name__ == "__main__":
    main()
