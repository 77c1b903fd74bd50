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


@dataclass(frozen=True)
class View:
    """An interactive picture of one model, or of two side by side. Notebooks display it.

    Attributes:
        contents: Displayed contents of each model.

    Example:
        >>> links = gaigs.links("synthetic_rssi", transmitters=60)
        >>> view = gaigs.view(gaigs.train("path_loss", links), links)
        >>> view.save("room.html")
    """

    contents: Sequence[Contents]

    @cached_property
    def facts(self) -> list[dict]:
        """Axes, units, room and receivers of each model, which hold for all transmitters."""
        return [contents.facts() for contents in self.contents]

    def save(self, path: str | Path) -> None:
        """Writes one HTML file with all predictions of some places.

        Any browser opens it without a server.

        Raises:
            OSError: The file cannot be written.
        """
        write_text(path, self.page(self.stored()))

    def serve(self, port: int = 8080) -> None:
        """Serves the page on this machine until Ctrl-C.

        The model predicts for every place to which the transmitter is dragged.

        Args:
            port: Port of http://127.0.0.1; 0 for any free port.

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
            address = f"http://127.0.0.1:{serving.server_port}"
            print(f"open {address} in a browser; Ctrl-C ends", flush=True)
            serving.serve_forever()

    def page(self, stored: dict | None = None) -> str:
        """The HTML page; without stored predictions the page asks its server for them."""
        # Colour maps of amplitudes and radio maps, of paths, of errors, and of Gaussians.
        colours = {}
        for name in ("viridis", "plasma_r", "YlOrRd", "Blues"):
            colours[name] = [colormaps[name](i, bytes=True)[:3] for i in range(256)]
        content = {"runs": self.facts, "stored": stored, "colours": colours}
        text = json.dumps(content, default=int, separators=(",", ":"))
        packed = gzip.compress(text.encode(), mtime=0)
        folder = files("gaigs.commands.view")
        page = folder.joinpath("page.html").read_text(encoding="utf-8")
        # The page has a mark such as @style@ where a file or the content belongs.
        insertions = {"style": "page.css", "drawing": "drawing.js", "script": "page.js"}
        for mark, name in insertions.items():
            text = folder.joinpath(name).read_text(encoding="utf-8")
            page = page.replace(f"@{mark}@", text)
        return page.replace("@content@", base64.b64encode(packed).decode())

    def stored(self, places: int = 96, fewest: int = 12, maps: int = 24, step: int = 3) -> dict:
        """Predictions for a page without a server, as JSON values.

        Places are evenly spread in the box of the training transmitters. Each has predictions for
        all receivers.

        Args:
            places: Approximate number of stored predictions of a model, over all receivers.
            fewest: Smallest number of places, for any number of receivers.
            maps: Largest number of slices of radio maps, over all heights and receivers.
            step: Rows and columns from one stored pixel of a spectrum to the next.
        """
        scene = self.contents[0].scene
        count = len(scene.receivers)
        grid = even_places(scene.lower, scene.upper, max(fewest, places // count))
        all_heights = grid[:, 2].unique()
        shown_heights = evenly(torch.arange(len(all_heights)), max(1, maps // count))
        heights = all_heights[shown_heights].tolist()  # of the radio maps
        runs = []
        for contents in self.contents:
            answers = []
            for place in grid.tolist():
                answers.append(
                    [contents.answer(place, receiver, step) for receiver in range(count)]
                )
            slices = []
            for height in heights if contents.has_map else ():
                slices.append([contents.slice(height, receiver) for receiver in range(count)])
            links = [contents.comparison(number, step) for number in range(len(contents.tests))]
            runs.append({"answers": answers, "maps": slices, "links": links})
        return {"places": grid.tolist(), "heights": heights, "runs": runs}

    def _repr_html_(self) -> str:
        page = html.escape(self.page(self.stored()))
        return f'<iframe srcdoc="{page}" style="width:100%;height:640px;border:0"></iframe>'


def view(model: Model, links: Links | None = None, other: Model | None = None) -> View:
    """A model in a browser: its room, and predictions for a transmitter that can be dragged.

    Args:
        model: A trained, fitted or loaded model.
        links: Data of the model; None: true walls and test links are not shown.
        other: A second model of the same receivers, shown beside the first.

    Raises:
        TypeError: A model is not a ``gaigs.Model``.
        ValueError: The links or the other model have different receivers, or the links another
            task.

    Example:
        >>> model = gaigs.train("mean", gaigs.links("synthetic", transmitters=20, order=0))
        >>> gaigs.view(model).save("spectra.html")
    """
    check_instance("model", model, Model)
    models = [model]
    if other is not None:
        check_instance("other", other, Model)
        models.append(other)
    if links is not None:
        check_instance("links", links, Links)
    contents = []
    for shown in models:
        name = name_of(shown.trend if isinstance(shown, Kriging) else shown)
        contents.append(Contents(shown, links, name))
    return View(side_by_side(contents))


def side_by_side(contents: list[Contents]) -> list[Contents]:
    """The given contents; raises a ``ValueError`` if their receivers differ."""
    scene = contents[0].scene
    places = scene.positions(scene.lower)
    names = [receiver.name for receiver in scene.receivers]
    for other in contents[1:]:
        other_names = [receiver.name for receiver in other.scene.receivers]
        if names != other_names or not torch.allclose(places, other.scene.positions(scene.lower)):
            raise ValueError(
                "two models side by side must have the same receivers, got "
                f"{', '.join(names[:5])} and {', '.join(other_names[:5])}, or other positions; "
                "view them one by one"
            )
    return contents


def contents_of(source: str | Path, trust: bool = False) -> Contents:
    """The contents of a run's folder, or of a checkpoint.

    A checkpoint comes without its links, and so does a run of arrays in memory.
    """
    path = Path(source)
    if path.is_file():
        return Contents(load(path, trust), title=path.stem)
    in_memory = configuration_of(path)["data"]["name"] == "arrays"  # which a run does not store
    return Contents(load(path, trust), None if in_memory else links_of(path, trust), path.name)


def run(config: dict) -> None:
    """Serves the view of a run's folder or of a checkpoint, or writes it into one file."""
    call("view", show, config["view"], folder=config["folder"], trust=config["trust"])


def show(
    folder: str, trust: bool, other: str | None = None, out: str | None = None, port: int = 8080
) -> None:
    """Shows one run, or two side by side, in a file ``out`` or, without it, by a server."""
    sources = [folder] if other is None else [folder, other]
    shown = View(side_by_side([contents_of(source, trust) for source in sources]))
    if out is None:
        shown.serve(port)
        return
    shown.save(out)
    print(f"results: {out}")
