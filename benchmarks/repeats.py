"""What a predictor from places could explain at most, by readings beside each other:
python benchmarks/repeats.py --survey FILE --gateways FILE --frequency HZ [--within 1.0].

An oracle takes the mean of all other readings of the receiver within a radius, those of the test
too. With few of them it errs more than with many: times the root of n / (n + 1) for as many as one
likes, if they scatter alike. Beside it is the Gaussian process of the known readings, at the same
test readings, and by the distance to the nearest known one. Split ``random``, seed 0.

Last come differences of readings near each other, of rows of the survey that follow one another,
so of one pass, and of rows far apart. Over the root of 2 they are errors of the mean of very many.
"""

import argparse
import itertools

import common
import numpy as np
from scipy.spatial import cKDTree

import gaigs
from gaigs.model.answers import predicted
from gaigs.registry import registry


def neighbours(links, within):
    """Of each test reading: the number of others of its receiver within a radius [m], their mean,
    and the distance to the nearest known reading [m].
    """
    places = links.query.transmitters.numpy()
    receivers = links.query.receivers.numpy()
    labels = links.labels.double().numpy()
    test = links.split.test.numpy()
    is_known = np.isin(np.arange(len(labels)), links.split.known.numpy())
    counts, means, apart = np.zeros(len(test), int), np.zeros(len(test)), np.zeros(len(test))
    for receiver in range(len(links.receivers)):
        own = np.flatnonzero(receivers == receiver)
        asked = np.flatnonzero(receivers[test] == receiver)
        apart[asked] = cKDTree(places[own[is_known[own]]]).query(places[test[asked]])[0]
        near = cKDTree(places[own]).query_ball_point(places[test[asked]], within)
        for row, members in zip(asked, near, strict=True):
            others = own[members]
            others = others[others != test[row]]
            counts[row] = len(others)
            means[row] = labels[others].mean() if len(others) else np.nan
    return counts, means, apart


def between_passes(links, nearest, farthest, follow=3, apart=50):
    """Mean differences over the root of 2 [dB] of readings of a receiver at places so far from each
    other [m], and their numbers: of rows at most ``follow`` from each other, and more than
    ``apart``.
    """
    receivers = links.query.receivers.numpy()
    found = []
    for receiver in range(len(links.receivers)):
        own = np.flatnonzero(receivers == receiver)
        places = links.query.transmitters[own].numpy()
        pairs = cKDTree(places).query_pairs(farthest, output_type="ndarray")
        steps = np.linalg.norm(places[pairs[:, 0]] - places[pairs[:, 1]], axis=1)
        one, other = own[pairs[steps >= nearest].T]
        rows = (links.rows[one] - links.rows[other]).abs().numpy()
        levels = (links.labels[one] - links.labels[other]).abs().double().numpy()
        found.append((rows, levels))
    rows, levels = (np.concatenate(parts) for parts in zip(*found, strict=True))
    differences = [levels[rows <= follow], levels[rows > apart]]
    return [(len(part), part.mean() / 2**0.5) for part in differences if len(part)]


def main():
    shape = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=shape)
    parser.add_argument("--survey", required=True, help="wide CSV")
    parser.add_argument("--gateways", required=True, help="CSV")
    parser.add_argument("--frequency", type=float, required=True, help="carrier [Hz]")
    parser.add_argument("--within", type=float, default=1.0, help="radius [m]")
    parser.add_argument("--fewest", type=common.positive, default=3, help="others within it")
    options = parser.parse_args()
    files = {"file": options.survey, "gateways": options.gateways}
    links = gaigs.links("rssi_wide", frequency=options.frequency, **files)
    test = links.split.test
    labels = links.labels[test].double().numpy()
    counts, means, apart = neighbours(links, options.within)
    model = registry("model").build({"name": "gaussian_process"}, scene=links.scene)
    model.fit(links)
    errors = np.abs(predicted(model, links, test).double().numpy() - labels)
    rows = counts >= options.fewest
    oracle = np.abs(means - labels)[rows]
    many = oracle * np.sqrt(counts[rows] / (counts[rows] + 1))
    print(f"{rows.sum()} of {len(test)} test readings, MAE [dB]: oracle {oracle.mean():.2f},")
    print(f"of many others {many.mean():.2f}, gaussian_process {errors[rows].mean():.2f}")
    edges = [0, 1, 2, 4, 8, 16, 32, 64]
    for low, high in itertools.pairwise(edges):
        part = (apart >= low) & (apart < high)
        if part.any():
            print(f"{low} to {high} m: {part.sum()} readings, {errors[part].mean():.2f} dB")
    for low, high in ((0, 2), (4, 8), (8, 16)):
        parts = between_passes(links, low, high)
        texts = [f"{difference:.2f} dB of {count} pairs" for count, difference in parts]
        print(f"{low} to {high} m from each other, one pass and another: {', '.join(texts)}")


if __name__ == "__main__":
    main()
