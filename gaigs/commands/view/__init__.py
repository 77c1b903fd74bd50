"""The viewer: a room, its paths and predictions in a browser, from a server or one file."""

import base64
import gzip
import html
import json
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from importlib.resources import files
from pathlib import Path

import torch
from matplotlib import colormaps

from gaigs.commands.view.contents import Contents
from gaigs.commands.view.server import server
from gaigs.core.geometry import even_places
from gaigs.core.query import evenly
from gaigs.data import Links
from gaigs.io.files import write_text
from gaigs.model import Model
from gaigs.model.kriging import Kriging
from gaigs.registry import call, check_instance, name_of
from gaigs.runs import configuration_of, links_of, load

PLACES = 96
"""About as many places of a transmitter are in a file, fewer with many receivers."""

FEWEST = 12
"""Places in a file with any number of receivers."""

MAPS = 24
"""Most slices of radio maps in a file."""

STEP = 3
"""Every so many rows and columns of a spectrum are in a file."""

COLOURS = "viridis", "plasma_r", "YlOrRd", "Blues"
"""Matplotlib's scales of amplitudes and maps, of paths, of errors, and of Gaussians."""


@dataclass(frozen=True)
class View:
    """A picture of one model or of two side by side; in a notebook it shows itself.

    Attributes:
        contents: One a model.

    Example:
        >>> links = gaigs.links("synthetic_rssi", transmitters=60)
        >>> view = gaigs.view(gaigs.train("path_loss", links), links)
        >>> view.save("room.html")
    """

    contents: Sequence[Contents]

    @cached_property
    def facts(self) -> list[dict]:
        """What does not depend on the transmitter, one a model."""
        return [each.facts() for each in self.contents]

    def save(self, path: str | Path) -> None:
        """Writes one HTML file with all predictions of some places, which any browser opens without
        a server.

        Raises:
            OSError: The file cannot be written.
        """
        write_text(path, self.page(self.stored()))

    def serve(self, port: int = 8080) -> None:
        """Serves the page on this machine until Ctrl-C; the model predicts wherever the transmitter
        is dragged.

        Args:
            port: Of http://127.0.0.1; 0 for any free one.

        Raises:
            OSError: The port cannot be opened.
        """
        try:
            serving = server(self.page(), list(self.contents), port)
        except OSError as error:
            raise OSError(
                f"port {port} cannot be opened ({error.strerror}); take another, or 0 for any"
            ) from None
        with serving:
            print(
                f"open http://127.0.0.1:{serving.server_port} in a browser; Ctrl-C ends", flush=True
            )
            serving.serve_forever()

    def page(self, stored: dict | None = None) -> str:
        """The HTML page; without stored predictions it asks the server that sent it."""
        colours = {
            name: [colormaps[name](i, bytes=True)[:3] for i in range(256)] for name in COLOURS
        }
        content = {"runs": self.facts, "stored": stored, "colours": colours}
        packed = gzip.compress(
            json.dumps(content, default=int, separators=(",", ":")).encode(), mtime=0
        )
        read = lambda name: files("gaigs.commands.view").joinpath(name).read_text(encoding="utf-8")
        parts = {
            "style": read("page.css"),
            "drawing": read("drawing.js"),
            "script": read("page.js"),
        }
        parts["content"] = base64.b64encode(packed).decode()
        text = read("page.html")
        for name, part in parts.items():
            text = text.replace(f"@{name}@", part)
        return text

    def stored(self) -> dict:
        """Predictions for transmitters at even places in the box of the training transmitters, for
        all receivers.
        """
        scene = self.contents[0].scene
        count = len(scene.receivers)
        places = even_places(scene.lower, scene.upper, max(FEWEST, PLACES // count))
        heights = places[:, 2].unique()
        heights = heights[evenly(torch.arange(len(heights)), max(1, MAPS // count))].tolist()
        runs = []
        for one in self.contents:
            answers = [
                [one.answer(place, k, STEP) for k in range(count)] for place in places.tolist()
            ]
            maps = [[one.slice(z, k) for k in range(count)] for z in heights] if one.has_map else []
            links = [one.comparison(k, STEP) for k in range(len(one.tests))]
            runs.append({"answers": answers, "maps": maps, "links": links})
        return {"places": places.tolist(), "heights": heights, "runs": runs}

    def _repr_html_(self) -> str:
        page = html.escape(self.page(self.stored()))
        return f'<iframe srcdoc="{page}" style="width:100%;height:640px;border:0"></iframe>'


def view(model: Model, links: Links | None = None, other: Model | None = None) -> View:
    """A picture of a model in a browser: its room, and its predictions for a transmitter to drag.

    Args:
        model: A trained, fitted or loaded model.
        links: Its data; None: no true walls and no test links are shown.
        other: A second model of the same receivers, beside the first.

    Raises:
        TypeError: A model is not a ``gaigs.Model``.
        ValueError: The links, or the other model, have other receivers; or the links have another
            task.

    Example:
        >>> model = gaigs.train("mean", gaigs.links("synthetic", transmitters=20, order=0))
        >>> gaigs.view(model).save("spectra.html")
    """
    for name, one in (("model", model), ("other", other)):
        if one is not None:
            check_instance(name, one, Model)
    if links is not None:
        check_instance("links", links, Links)
    shown = [one for one in (model, other) if one is not None]
    names = [name_of(one.trend if isinstance(one, Kriging) else one) for one in shown]
    return View(
        side_by_side([Contents(one, links, name) for one, name in zip(shown, names, strict=True)])
    )


def side_by_side(contents: list[Contents]) -> list[Contents]:
    """The contents; a ``ValueError`` if they are not of the same receivers."""
    own = contents[0].scene
    for each in contents[1:]:
        names = [[one.name for one in scene.receivers] for scene in (own, each.scene)]
        if names[0] != names[1] or not torch.allclose(
            own.positions(own.lower), each.scene.positions(own.lower)
        ):
            raise ValueError(
                f"two models side by side must have the same receivers, got {', '.join(names[0][:5])} and "
                f"{', '.join(names[1][:5])}, or other positions; view them one by one"
            )
    return contents


def contents_of(source: str | Path, trust: bool = False) -> Contents:
    """The contents of a run's folder, or of a checkpoint without its data."""
    path = Path(source)
    if path.is_file():
        return Contents(load(path, trust), title=path.stem)
    in_memory = configuration_of(path)["data"]["name"] == "arrays"  # which a run does not store
    return Contents(load(path, trust), None if in_memory else links_of(path, trust), path.name)


def run(config: dict) -> None:
    """Serves the view of a run's folder or of a checkpoint, or writes it into one file."""
    if config["folder"] is None:
        raise ValueError(
            "command=view needs the folder of a finished run, or a checkpoint; add folder=runs/..."
        )
    call("view", show, config["view"], folder=config["folder"], trust=config["trust"])


def show(
    folder: str, trust: bool, other: str | None = None, out: str | None = None, port: int = 8080
) -> None:
    """One run, or two side by side: in a file ``out``, or without one by a server."""
    shown = View(
        side_by_side(
            [contents_of(source, trust) for source in (folder, other) if source is not None]
        )
    )
    if out is None:
        shown.serve(port)
        return
    shown.save(out)
    print(f"results: {out}")
