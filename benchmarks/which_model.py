"""Test scores of ``model=auto`` beside those of each of its candidates.

    python benchmarks/which_model.py --data DIR
    python benchmarks/which_model.py --places 30 100 --seeds 0 1 --sets "built-in room, RSSI" ...

DIR holds the sets of measurements by name; a missing one is left out, and so are traced rooms
without Sionna RT. With ``--places`` so many random places are known (split ``sparse``). A seed is
that of the split and of trainings. Trained candidates have ``--max-steps`` steps, so that scores
depend little on the machine. ``--folder`` goes on with the rows that are missing there.
"""

import argparse
import itertools
import json
import time
from importlib.util import find_spec
from pathlib import Path

import gaigs
from gaigs.report.scores import headline, task_class
from gaigs.report.table import markdown
from gaigs.runs.evaluation import score, summary

SETS = {
    "ble-tetam": ("nerf2_rssi", {"root": "ble-tetam"}),
    "newrf-conference": ("csi_npz", {"file": "newrf-conference/room.npz"}),
    "built-in room, RSSI": ("synthetic_rssi", {}),
    "rfid-s23-200": ("nerf2_spectrum", {"root": "rfid-s23-200"}),
    "built-in room, channels": ("synthetic_csi", {}),
    "built-in room, spectra": ("synthetic", {}),
    "ble-flat": ("nerf2_rssi", {"root": "ble-flat"}),
    "uwb-apartment": (
        "csi_npz",
        {"file": "uwb-apartment/room.npz", "phase": "per_link_and_delay"},
    ),
    "powder-462": (
        "rssi_wide",
        {
            "file": "powder-462/survey.csv",
            "gateways": "powder-462/gateways.csv",
            "frequency": 462.7e6,
        },
    ),
    "rfid-s23": ("nerf2_spectrum", {"root": "rfid-s23"}),
    "furnished room, traced spectra": ("sionna", {"room": "furnished"}),
    "L-shaped room, traced spectra": ("sionna", {"room": "l_shape"}),
}
"""Reader and options of each set; paths are those below the folder of measurements."""

PATHS = ("root", "file", "gateways")
"""Options that are paths."""

MARGINS = {"mae_db": 0.05, "ssim_median": 0.003, "snr_db_median": 0.5, "snr_aligned_db_median": 0.5}
"""Largest loss against the best candidate that is wanted, by score."""


def measure(name, places, seed, data, steps, folder):
    """Test scores of the choice and of all candidates on one set, with some places or all."""
    reader, options = SETS[name]
    paths = {key: str(data / options[key]) for key in PATHS if key in options}
    split = {} if places is None else {"split": "sparse", "train": places}
    split |= {"split.seed": seed} if seed else {}
    links = gaigs.links(reader, **options | paths | split)
    began = time.process_time()
    options = {"max_steps": steps, "val_check_interval": min(50, steps), "seed": seed}
    chosen = gaigs.train(links, folder=folder, **options, **{"model.max_time": "00:02:00:00"})
    minutes = (time.process_time() - began) / 60
    config = gaigs.compose("model=auto", f"task={links.task.name}")
    models = {"auto": chosen}
    for number, candidate in enumerate(config["model"]["candidates"]):
        checkpoint = folder / "candidates" / str(number) / "best.ckpt"
        if checkpoint.is_file():  # of the trained ones, and of the chosen one
            models[candidate] = gaigs.load(checkpoint)
        else:
            models[candidate] = gaigs.train(candidate, links, seed=seed)
    scores = score(models, {}, links)
    summaries = {key: summary(links.task, values) for key, values in scores.items()}
    first, metric = headline(links.task.name, summaries)
    title = name if places is None else f"{name}, {places} places"
    title += f", seed {seed}" if seed else ""
    row = {
        "set": title,
        "minutes": minutes,
        "task": links.task.name,
        "split": links.split.name,
        "metric": first,
    }
    counts = [len(part) for part in links.split.parts().values()]
    row |= {"chosen": short_name(chosen), "counts": counts}
    row["scores"] = {key: values[first] for key, values in summaries.items()}
    row["higher_is_better"] = metric.higher_is_better
    return row


def short_name(model):
    """Name of a model; of a kriged one that of its trend, of a blend its members' with shares."""
    name = model.configuration["name"]
    if name == "ensemble":
        pairs = zip(model.weights, model.members, strict=True)
        return " + ".join(f"{weight:.2g} {short_name(member)}" for weight, member in pairs)
    return model.trend.configuration["name"] if name == "kriging" else name


def line(row):
    """A row of the table; the best candidate is in bold."""
    scores = dict(row["scores"])
    auto = scores.pop("auto")
    best = (max if row["higher_is_better"] else min)(scores.values())
    loss = best - auto if row["higher_is_better"] else auto - best
    margin = MARGINS.get(row["metric"])
    kept = "" if margin is None else ("yes" if loss <= margin else "no")
    title = task_class(row["task"]).metrics()[row["metric"]].title
    texts = []
    for name in ("path_loss", "friis", "knn", "gaussian_process", "mirrored", "gaigs"):
        text = f"{scores[name]:.3f}" if name in scores else ""
        texts.append(f"**{text}**" if name in scores and scores[name] == best else text)
    counts = " / ".join(map(str, row["counts"]))
    costs = f"{loss:.3f}", kept, f"{row['minutes']:.1f}"
    return [row["set"], title, counts, f"{auto:.3f}", row["chosen"], *texts, *costs]


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--data", type=Path, default=Path(), help="folder of the measured sets")
    parser.add_argument("--folder", type=Path, default=Path("runs/which_model"))
    parser.add_argument("--max-steps", type=int, default=300)
    parser.add_argument("--sets", nargs="+", choices=SETS, default=[*SETS])
    parser.add_argument("--places", nargs="+", type=int, default=[None])
    parser.add_argument("--seeds", nargs="+", type=int, default=[0])
    arguments = parser.parse_args()
    head = "set, score, links to train / validate / test, auto, chosen, path_loss, friis, knn, "
    head += "gaussian_process, mirrored, gaigs, behind the best, within the margin, processor [min]"
    lines = [head.split(", ")]
    cells = itertools.product(arguments.sets, arguments.places, arguments.seeds)
    for name, places, seed in cells:
        folder = f"{name} {places or ''}".strip().replace(" ", "_").replace(",", "")
        folder += f"_seed_{seed}" if seed else ""
        place = arguments.folder / folder
        place.mkdir(parents=True, exist_ok=True)
        file = place / "row.json"
        if not file.is_file():
            options = SETS[name][1]
            paths = [arguments.data / options[key] for key in PATHS if key in options]
            is_traced = SETS[name][0] == "sionna"
            if not all(path.exists() for path in paths) or (is_traced and not find_spec("sionna")):
                print(f"left out, as not there: {name}")
                continue
            row = measure(name, places, seed, arguments.data, arguments.max_steps, place / "run")
            file.write_text(json.dumps(row, indent=2))
        lines.append(line(json.loads(file.read_text())))
        print(" | ".join(lines[-1]), flush=True)
    print(markdown(lines))


if __name__ == "__main__":
    main()
