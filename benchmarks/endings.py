"""What ends a training of spectra best: validation scores of schedules, averages and disturbances.

    python benchmarks/endings.py
    python benchmarks/endings.py data=nerf2_spectrum data.root=DIR split=runs split.length=20

Overrides are those of ``python -m gaigs +experiment=spectrum``; the test links are not looked at.
Each training has the same steps and is scored by the mean SSIM of the validation links, as it ends
and with exponential averages of its weights.

=============  =====================================================================
way            change
=============  =====================================================================
usual          none: the rates fall exponentially to ``training.schedule.final``
cosine         the rates fall to zero along half a cosine
constant       the rates do not fall
dropout        a tenth of the Gaussians, drawn anew in each step, is transparent
jitter         places move by 0.01 m in each step (standard deviation of an axis)
=============  =====================================================================
"""

import argparse
import math
from dataclasses import replace

import lightning
import torch
from torch import nn
from torch.optim.lr_scheduler import LambdaLR
from torch.optim.swa_utils import AveragedModel, get_ema_multi_avg_fn

import gaigs
from gaigs.data import Links, load
from gaigs.model import Model
from gaigs.registry import registry
from gaigs.report.table import markdown
from gaigs.training import seeded
from gaigs.training.schedule import make_optimizer, make_schedule

WAYS = ("usual", "cosine", "constant", "dropout", "jitter")

DECAYS = (0.98, 0.995)
"""Of averages: about the last 50 and the last 200 steps."""


def drop_gaussians(model: Model, share: float) -> None:
    """Has a share of the Gaussians transparent in each training step."""

    def drop(module, arguments, residuals):
        if not module.training:
            return residuals
        opacities = residuals.delta_opacities  # (b, n)
        dropped = torch.rand(opacities.shape[1]) < share  # (n,)
        # Opacities are clamped at 0 behind the residual.
        return residuals._replace(delta_opacities=opacities.masked_fill(dropped, -1.0))

    model.deformation.register_forward_hook(drop)


def train(way: str, links: Links, config: dict, steps: int, seed: int) -> list[float]:
    """Scores of a training: its end, then each average."""
    lightning.seed_everything(seed, verbose=False)
    model = registry("model").build(config["model"], scene=links.scene)
    model.fit(links)
    if way == "dropout":
        drop_gaussians(model, 0.1)
    training = config["training"]
    rates = model.learning_rates | training["learning_rates"]
    optimizer = make_optimizer(training["optimizer"], model.parameter_groups(), rates)
    options = training["schedule"] | ({"final": 1.0} if way in ("cosine", "constant") else {})
    schedule = make_schedule(options, optimizer, lambda step: step / steps)
    if way == "cosine":
        schedule = LambdaLR(
            optimizer,
            lambda step: min(1.0, (step + 1) / 50) * (1 + math.cos(math.pi * step / steps)) / 2,
        )
    weights = nn.ParameterList(model.parameters())
    averages = [AveragedModel(weights, multi_avg_fn=get_ema_multi_avg_fn(d)) for d in DECAYS]
    loss = registry("loss").build(config["loss"], task=links.task)
    thin = links.task.thinning(**training["thinning"])
    generator = torch.Generator().manual_seed(seed)
    train = links.split.train
    for step in range(steps):
        order = torch.randperm(len(train), generator=generator)[: training["batch_size"]]
        batch = thin(links.batch(train[order]), seeded(seed, step))
        if way == "jitter":
            places = batch.query.transmitters
            moved = places + 0.01 * torch.randn(places.shape, generator=generator)
            batch = replace(batch, query=replace(batch.query, transmitters=moved))
        value, penalties = model(batch)
        total = loss(value, batch)[0]
        for name, penalty in penalties.items():
            total = total + model.penalty_weights[name] * penalty
        optimizer.zero_grad()
        total.backward()
        optimizer.step()
        schedule.step()
        for average in averages:
            average.update_parameters(weights)
    model.eval()
    scores = [score(model, links)]
    for average in averages:
        with torch.no_grad():
            for own, mean in zip(weights, average.module, strict=True):
                own.copy_(mean)
        scores.append(score(model, links))
    return scores


@torch.no_grad()
def score(model: Model, links: Links) -> float:
    """Mean SSIM of the validation links."""
    batch = links.batch(links.split.validation)
    return links.task.scores(batch.labels, model.evaluate(batch))["ssim"].mean().item()


def main() -> None:
    shape = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=shape)
    parser.add_argument("overrides", nargs="*", metavar="KEY=VALUE")
    parser.add_argument("--ways", nargs="+", choices=WAYS, default=WAYS)
    parser.add_argument("--steps", type=int, default=1000)
    parser.add_argument("--seeds", type=int, nargs="+", default=[0])
    options = parser.parse_intermixed_args()
    config = gaigs.compose("+experiment=spectrum", *options.overrides)
    links = load(config["data"], config["split"])
    rows = [("way", "seed", "end", *(f"average {decay}" for decay in DECAYS))]
    for seed in options.seeds:
        for way in options.ways:
            scores = train(way, links, config, options.steps, seed)
            rows.append((way, str(seed), *(f"{value:.3f}" for value in scores)))
            print(*rows[-1], flush=True)
    print(f"split {links.split.name}\n\n{markdown(rows)}")


if __name__ == "__main__":
    main()
