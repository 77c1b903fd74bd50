"""Error after n places that a survey plans, beside n and 1.4 n random ones: python
benchmarks/survey.py [--flat DIR].

One set is an invented floor, of which each receiver hears a part. Places are planned at once before
anything is measured, or anew by a model at 40 and 60. Candidates are four fifths of the known
places, at most 1,500. A Gaussian process is fitted to the chosen places, and scored on the official
test. Seeds 0 to 4 draw the candidates and the random places.
"""

import argparse
from dataclasses import replace

import numpy as np
import torch

import gaigs

COUNTS = (20, 40, 60, 100)


def floor():
    """RSSI on 40 m x 25 m: 400 places, 14 receivers that hear down to a level, shadowing of 4 dB,
    noise of 2 dB.
    """
    rng = np.random.default_rng(0)
    places = rng.uniform((0, 0, 1), (40, 25, 1.6), (400, 3))
    receivers = rng.uniform((0, 0, 2), (40, 25, 2.5), (14, 3))
    apart = np.linalg.norm(places[:, None] - receivers, axis=-1)
    shadowing = np.exp(-np.linalg.norm(places[:, None] - places, axis=-1) / 4) + 1e-9 * np.eye(400)
    levels = (
        -45
        + 3 * rng.standard_normal(14)
        - 10 * (3 + 0.3 * rng.standard_normal(14)) * np.log10(apart)
    )
    levels += 4 * np.linalg.cholesky(shadowing) @ rng.standard_normal(
        (400, 14)
    ) + 2 * rng.standard_normal((400, 14))
    levels[levels < -45 - 30 * np.log10(15)] = np.nan
    return gaigs.links(
        task="rssi", transmitters=places, receivers=receivers, labels=levels, split="random"
    )


def score(links, places):
    """Mean absolute error, or 1 - mean SSIM, of a Gaussian process of some places."""
    train = links.split.known
    rows = train[(links.query.transmitters[train][:, None] == places).all(-1).any(1)]
    known = replace(links, split=replace(links.split, train=rows, validation=rows[:0]))
    model = gaigs.registries["model"].build(
        {"name": "gaussian_process", "trend": None}, scene=known.scene
    )
    model.fit(known)  # gaigs.train would calibrate its intervals too
    numbers = gaigs.evaluate(model, known, []).models["gaussian_process"]
    return model, 1 - numbers["ssim_mean"] if links.task.name == "spectrum" else numbers["mae_db"]


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--flat", help="folder of ble-flat")
    arguments = parser.parse_args()
    sets = {"built-in RSSI": gaigs.links("synthetic_rssi"), "invented floor": floor()}
    sets["built-in spectra"] = gaigs.links("synthetic")
    if arguments.flat:
        sets["ble-flat"] = gaigs.links("nerf2_rssi", root=arguments.flat)
    print(
        "| data | places | planned at once | anew at 40 and 60 | as many random | 1.4 times as "
        "many random |"
    )
    print("|---|---|---|---|---|---|")
    for name, links in sets.items():
        known = links.split.known
        places = links.query.transmitters[known].unique(dim=0)
        rows = {count: [] for count in COUNTS}
        for seed in range(5):
            order = places[
                torch.randperm(len(places), generator=torch.Generator().manual_seed(seed))
            ]
            random, candidates = order.flip(0), order[: min(1500, 4 * len(order) // 5)]
            planned = gaigs.survey(candidates=candidates, count=max(COUNTS)).places
            anew = planned[:40]
            for count in COUNTS:
                if count > len(anew):
                    left = candidates[~(candidates[:, None] == anew).all(-1).any(1)]
                    plan = gaigs.survey(
                        score(links, anew)[0], count=count - len(anew), candidates=left
                    )
                    anew = torch.cat((anew, plan.places))
                parts = planned[:count], anew[:count], random[:count], random[: round(1.4 * count)]
                rows[count].append([score(links, part)[1] for part in parts])
        for count, values in rows.items():
            means = torch.tensor(values).mean(0).tolist()
            print(
                f"| {name} | {count} | " + " | ".join(f"{mean:.3f}" for mean in means) + " |",
                flush=True,
            )


if __name__ == "__main__":
    main()
