"""Two access points chosen by predicted levels, beside the best pair by the true levels: python
benchmarks/place.py [--mirrored FILE].

Links are those of ``synthetic_rssi``. Candidates stand 10 cm off the walls of the built-in room,
0.5 m apart at three heights, outside the furniture. The simulation gives the true level of each
candidate at 600 further places; a reading scatters about it by 2 dB. All pairs are judged by these
levels: those chosen by the predictions of models, or by the true levels, the median, and the best
one; beside the four gateways of the room, or none. The training of ``mirrored`` takes a minute on a
free core.
"""

import argparse

import torch

import gaigs
from gaigs.commands.place.objectives import Coverage, LocationError, MeanLevel, choose, product_of
from gaigs.data.readings import gateway
from gaigs.data.simulation import rss_dbm
from gaigs.data.synthetic import ROOM, default_room
from gaigs.data.synthetic.image_source import is_free

NOISE, CARRIER, BAND = 2.0, 2.441e9, 78e6


def candidates(spacing=0.5, margin=0.1, heights=(1.2, 1.8, 2.4)):
    """Places along the walls, (c, 3) [m]."""
    width, depth, _ = ROOM.size
    points = []
    for height in heights:
        for x in torch.arange(margin, width - margin + 1e-6, spacing).tolist():
            points += [(x, margin, height), (x, depth - margin, height)]
        for y in torch.arange(margin + spacing, depth - margin - 1e-6, spacing).tolist():
            points += [(margin, y, height), (width - margin, y, height)]
    places = torch.tensor(points)
    return places[is_free(ROOM, places)]


def true_levels(room, sites, places):
    """Levels without noise (c, g) [dBm]."""
    offsets = room.frequency_offsets(BAND)
    levels = []
    for site in sites.tolist():
        responses = room.respond(places, gateway("site", tuple(site)), CARRIER, offsets)
        levels.append(torch.cat([*map(rss_dbm, responses)]))
    return torch.stack(levels)


def rules(places, threshold):
    """Objectives by name, each a function of levels and deviations."""
    return {
        "coverage": lambda *levels: Coverage(*levels, threshold),
        "mean": MeanLevel,
        "locate": lambda *levels: LocationError(*levels, places),
    }


def pair_scores(rule, standing):
    """Mean quality of each pair of candidates beside the first ``standing`` receivers (pairs,)."""
    rows = torch.arange(len(rule.values))
    scores = []
    for row in rows[standing:-1]:
        first = product_of(rule, torch.cat((rows[:standing], row[None])))
        for part in rows[row + 1 :].split(16):
            scores.append(rule.quality(first * rule.factors(part)).mean(-1))
    return torch.cat(scores)


def score(rule, standing, chosen):
    """Mean quality of chosen receivers beside those that stand."""
    members = torch.cat((torch.arange(standing), chosen))
    return rule.quality(product_of(rule, members)).mean().item()


def main():
    shape = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=shape)
    parser.add_argument("--mirrored", help="a checkpoint, in place of the training")
    parser.add_argument("--thresholds", nargs="+", type=float, default=[-65, -60, -55, -50])
    options = parser.parse_args()
    links = gaigs.links("synthetic_rssi")
    room = default_room(2)
    places = room.place(600, 1000)
    sites = candidates()
    stands = links.scene.positions(sites)
    truth = true_levels(room, torch.cat((stands, sites)), places)  # (k + c, g)
    models = {"path_loss": gaigs.train("path_loss", links)}
    if options.mirrored:
        models["mirrored"] = gaigs.load(options.mirrored)
    else:
        models["mirrored"] = gaigs.train("mirrored", links, boxes=True)
    cases = [("coverage", threshold) for threshold in options.thresholds]
    cases += [("mean", 0.0), ("locate", 0.0)]
    names = [*models, "true levels"]
    print(f"{len(sites)} candidates, {len(sites) * (len(sites) - 1) // 2} pairs")
    print(f"| objective | beside | {' | '.join(names)} | median pair | best pair |")
    print("|---|---|" + "---|" * (len(names) + 2))
    for known in (False, True):
        levels = truth if known else truth[len(stands) :]
        standing = len(stands) if known else 0
        for objective, threshold in cases:
            # Pairs of matrices of all places by all places take long.
            part = slice(None, 150 if objective == "locate" else None)
            make = rules(places[part], threshold)[objective]
            rule = make(levels[:, part], torch.full_like(levels[:, part], NOISE))
            pairs = pair_scores(rule, standing)
            best = (pairs.max() if rule.sign > 0 else pairs.min()).item()
            texts = []
            for model in models.values():
                plan = gaigs.place(model, sites, 2, objective, threshold, known=known)
                chosen = (sites[:, None] == plan.places).all(-1).nonzero()
                order = chosen[chosen[:, 1].argsort(), 0] + standing
                texts.append(f"{score(rule, standing, order):.2f}")
            order, _ = choose(rule, standing, 2)
            texts += [f"{score(rule, standing, order):.2f}", f"{pairs.median():.2f}", f"{best:.2f}"]
            title = f"above {threshold:g} dBm [%]" if objective == "coverage" else objective
            beside = "4 gateways" if known else "none"
            print(f"| {title} | {beside} | {' | '.join(texts)} |", flush=True)


if __name__ == "__main__":
    main()
