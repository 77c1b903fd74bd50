"""Scores of fits of one gain over free space to channels, and the influence of a few links on them.

    python benchmarks/channel_gains.py                                   the built-in room
    python benchmarks/channel_gains.py l_shape slanted furnished         rooms of the ray tracer; needs sionna-rt

Gains are fitted to the training links, scores are of the validation links, a quarter of those that
are not tested on. Prints a table in Markdown: median SNR and mean SINAD [dB], and by how much the
gain changes [dB] where one training link is scaled by 1e-6, ten by 1e-3, and one by 1e3.
docs/results.md has the numbers.
"""

import torch
from common import words
from jaxtyping import Complex
from torch import Tensor

from gaigs.core.propagation import fit_gain
from gaigs.core.scene import direct_gains, direct_waves
from gaigs.data import Links, load
from gaigs.report.table import markdown

Channels = Complex[Tensor, "k m"]


def weighed(h: Channels, w: Channels, weights: Tensor) -> Complex[Tensor, ""]:
    """Least squares, links weighed."""
    return (weights * (w.conj() * h).sum(1)).sum() / (weights * w.abs().square().sum(1)).sum()


def reweighted(h: Channels, w: Channels, weigh) -> Complex[Tensor, ""]:
    """Least of a function of relative errors, from the median link's gain; ``weigh`` is its
    derivative.
    """
    gain, powers = fit_gain(h, w), h.abs().square().sum(1)
    for _ in range(200):
        gain = weighed(h, w, weigh((h - gain * w).abs().square().sum(1) / powers) / powers)
    return gain


FITS = {
    "median link (`fit_gain`)": fit_gain,
    "least squares": lambda h, w: weighed(h, w, torch.ones(len(h))),
    "weights 1 / amplitude": lambda h, w: weighed(h, w, 1 / h.norm(dim=1)),
    "relative errors r": lambda h, w: weighed(h, w, 1 / h.abs().square().sum(1)),
    "ln(r + 0.001)": lambda h, w: reweighted(h, w, lambda r: 1 / (r + 0.001)),
    "ln(r + 0.1)": lambda h, w: reweighted(h, w, lambda r: 1 / (r + 0.1)),
    "r / (r + 0.3)": lambda h, w: reweighted(h, w, lambda r: 1 / (r + 0.3).square()),
}


def channels(links: Links, index: Tensor) -> tuple[Channels, Channels]:
    """Labels, and channels of free space."""
    query, scene = links.query[index], links.scene
    waves = direct_gains(scene, query)[:, None, None] * direct_waves(
        scene, query, scene.task.frequencies
    )
    return links.labels[index].to(torch.complex128).flatten(1), waves.flatten(1)


def main(rooms: list[str]) -> None:
    lines = [
        (
            "room",
            "fit",
            "gain [dB]",
            "median SNR",
            "mean SINAD",
            "one x 1e-6",
            "ten x 1e-3",
            "one x 1e3",
        )
    ]
    for room in rooms or ["built-in"]:
        data = (
            {"name": "synthetic_csi"}
            if room == "built-in"
            else {"name": "sionna_csi", "room": room}
        )
        links = load(data, {"name": "official", "validation": 0.25, "seed": 0}, "csi")
        (h, w), (labels, waves) = (
            channels(links, part) for part in (links.split.train, links.split.validation)
        )
        some = torch.randperm(len(h), generator=torch.Generator().manual_seed(0))
        for name, fit in FITS.items():
            gain = fit(h, w)
            summary = links.task.summarise(
                links.task.scores(
                    *(part.unflatten(1, links.task.shape) for part in (labels, gain * waves))
                )
            )
            changes = []
            for count, factor in ((1, 1e-6), (10, 1e-3), (1, 1e3)):
                changed = h.index_put((some[:count],), factor * h[some[:count]])
                changes.append(20 * (fit(changed, w) / gain).abs().log10())
            numbers = (
                20 * gain.abs().log10(),
                summary["snr_db_median"],
                summary["sinad_db_mean"],
                *changes,
            )
            lines.append((room, name, *(f"{number:.2f}" for number in numbers)))
    print(markdown(lines))


if __name__ == "__main__":
    main(words(__doc__, "ROOM"))
