"""A small radiance field: 64 samples along every ray, each through a network.

As a program it trains one on random rays, validates 16 whole spectra in one batch, and says how much memory that took.
"""

import json
import re
import resource
import sys
from pathlib import Path

import torch
from fitting import fit, make_links, make_module
from torch import nn

from gaigs.data import Links, Split
from gaigs.directions import Grid
from gaigs.loss.squared import Squared
from gaigs.model import Model, Prediction
from gaigs.query import Query
from gaigs.task.spectrum import Spectrum

SAMPLES = 64
"""Along a ray."""

WIDTH = 32
"""Of the network's hidden layer."""


class Field(Model):
    """Density and strength along each ray, composited front to back."""

    chunk = 1024

    def __init__(self, scene):
        super().__init__(scene)
        self.network = nn.Sequential(nn.Linear(6, WIDTH), nn.ReLU(), nn.Linear(WIDTH, 2))
        self.asked = set()  # numbers of pairs of a link and a direction at a time

    def forward(self, batch):
        links, directions = len(batch), batch.directions.vectors()
        self.asked.add(links * directions[..., 0].numel())
        depths = torch.linspace(0.1, 5.0, SAMPLES).to(directions)
        points = directions[..., None, :] * depths[:, None]
        places = batch.query.transmitters.reshape(links, *[1] * (points.ndim - 1), 3)
        inputs = torch.cat(torch.broadcast_tensors(points, places), -1)
        density, strength = self.network(inputs).unbind(-1)
        passed = torch.exp(-density.exp() * (depths[1] - depths[0]))
        reached = torch.cat((torch.ones_like(passed[..., :1]), passed[..., :-1]), -1).cumprod(-1)
        return Prediction((reached * (1 - passed) * strength.sigmoid()).sum(-1), {})


def make(links, rays):
    """A training of the field on so many random rays a step."""
    options = {"thinning": {"rays": rays}, "penalties": {}, "learning_rates": {"network": 0.01}}
    return make_module(links, Field(links.scene), Squared(links.task), batch_size=16, **options)


def full_size():
    """16 spectra of 90 x 360 to train on, and 16 to validate on: brighter the nearer to a direction of the place."""
    generator = torch.Generator().manual_seed(0)
    grid = Grid.degrees()
    places = 4 * torch.rand(33, 3, generator=generator) - 2
    toward = nn.functional.normalize(places, dim=-1)
    labels = torch.einsum("kd,rcd->krc", toward, grid.vectors()).clamp(min=0)
    return Links(
        query=Query(places, torch.zeros(33, dtype=torch.long)),
        receivers=make_links().receivers,
        labels=labels,
        task=Spectrum(grid.elevations, grid.azimuths, "none"),
        split=Split("16, 16 and 1", *torch.arange(33).split((16, 16, 1))),
    )


def peak():
    """Most memory that this program has had [B]."""
    status = Path("/proc/self/status")
    if status.is_file():  # the other figure counts the memory of whoever started this program
        return 1024 * int(re.search(r"VmHWM:\s*(\d+)", status.read_text())[1])
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * (1 if sys.platform == "darwin" else 1024)


def main():
    torch.set_num_threads(1)
    links = full_size()
    module = make(links, rays=512)
    trainer = fit(module, links, Path(sys.argv[1]), 5, at_a_time=16)
    told = {
        "peak_gib": peak() / 2**30,
        "mae": trainer.callback_metrics["validation/mae"].item(),
        "asked": list(module.model.asked),
    }
    Path(sys.argv[1], "told.json").write_text(json.dumps(told))


if __name__ == "__main__":
    main()
