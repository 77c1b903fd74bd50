"""The first picture of README.md: python benchmarks/front_picture.py RUN FILE.png, of a run of
+experiment=mirrored.

Left the learnt planes over the true room, and the paths of a transmitter in it. Right its measured
and its predicted spectrum. The transmitter is the test transmitter with the median SSIM.
"""

import argparse
import io
from dataclasses import replace
from pathlib import Path

import numpy as np
import yaml
from matplotlib import colormaps, rc_context
from matplotlib.colors import to_rgba
from matplotlib.figure import Figure
from mpl_toolkits.mplot3d.art3d import Line3DCollection, Poly3DCollection
from PIL import Image

import gaigs
from gaigs.data import load
from gaigs.report.style import BLUE, GREEN, ORANGE, PAGE, STYLE

DYNAMIC = 30
"""Powers that the colours of paths span [dB]."""


def draw_room(ax, links, learnt):
    """True edges in grey, learnt planes in blue, and paths by their power."""
    edges = links.edges.numpy()
    ax.add_collection3d(Line3DCollection(edges, colors="0.55", linewidths=0.7))
    outlines = [plane.corners for plane in learnt.planes]
    ax.add_collection3d(
        Poly3DCollection(outlines, facecolors=to_rgba(BLUE, 0.04), edgecolors=BLUE, linewidths=1.2)
    )
    colours = colormaps["plasma_r"](
        np.interp([path.power_db for path in learnt.paths], (-DYNAMIC, 0), (0.1, 0.95))
    )
    widths = np.interp([path.power_db for path in learnt.paths], (-DYNAMIC, 0), (0.6, 2.2))
    ax.add_collection3d(
        Line3DCollection([path.points for path in learnt.paths], colors=colours, linewidths=widths)
    )
    ends = learnt.paths[0].points
    marks = {"markeredgecolor": "white", "linestyle": "none", "zorder": 10}
    ax.plot(*ends[:1].T, marker="o", color=ORANGE, label="transmitter", **marks)
    ax.plot(*ends[-1:].T, marker="s", color=GREEN, label="receiver", **marks)
    ax.plot([], [], color="0.55", label="true room")
    ax.plot([], [], color=BLUE, label="learnt planes")
    corners = np.concatenate((edges.reshape(-1, 3), *outlines))
    lower, upper = corners.min(0), corners.max(0)
    ax.set(xlim=(lower[0], upper[0]), ylim=(lower[1], upper[1]), zlim=(lower[2], upper[2]))
    ax.set_box_aspect(upper - lower, zoom=0.98)
    ax.view_init(elev=33, azim=-66)
    ax.set_axis_off()


def draw_sky(ax, grid, values, title):
    """A spectrum as the sky above the array, the zenith in the middle."""
    edges = np.arange(361), np.arange(0, 91)
    ax.pcolormesh(
        np.deg2rad(edges[0]), edges[1], values[::-1], cmap="magma", vmin=0, vmax=1, rasterized=True
    )
    ax.set_xticks([])
    ax.set_yticks([])
    ax.spines[:].set_visible(False)
    ax.set_title(title, pad=3)


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("run", type=Path)
    parser.add_argument("file", type=Path)
    arguments = parser.parse_args()
    config = yaml.safe_load((arguments.run / "config.yaml").read_text())
    links = load(config["data"], config["split"])
    model = gaigs.load(arguments.run / "best.ckpt")
    scores = gaigs.evaluate(model, links, []).scores["mirrored"]["ssim"].numpy()
    middle = int(np.argsort(scores)[len(scores) // 2])
    number = links.split.test[middle : middle + 1]
    chosen = replace(links, split=replace(links.split, test=number))
    batch = links.batch(number)
    prediction = model.predict(batch.query)[0].numpy()
    with rc_context(STYLE):
        figure = Figure(figsize=(PAGE, 3.1))
        room = figure.add_axes((-0.06, -0.06, 0.74, 1.2), projection="3d")
        draw_room(room, chosen, model.learnt_room(chosen))
        figure.legend(
            *room.get_legend_handles_labels(),
            loc="lower left",
            ncols=4,
            bbox_to_anchor=(0.02, -0.01),
        )
        for left, values, title in (
            (0.62, batch.labels[0].numpy(), "measured"),
            (0.81, prediction, f"predicted, SSIM {scores[middle]:.3f}"),
        ):
            draw_sky(
                figure.add_axes((left, 0.22, 0.18, 0.56), projection="polar"),
                batch.directions,
                values,
                title,
            )
        picture = io.BytesIO()
        figure.savefig(picture, dpi=180)
    Image.open(picture).convert("RGB").quantize(255).save(
        arguments.file, optimize=True
    )  # a third of the bytes


if __name__ == "__main__":
    main()
