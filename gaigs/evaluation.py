"""What a run reports of a trained model and its baselines: scores, times, predictions, figures."""

import io
import platform
import statistics
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Int
from rich.console import Console, Group
from rich.jupyter import JupyterMixin
from torch import Tensor

from gaigs.configuration import composed, has_file
from gaigs.data import Links, Split, check_fit
from gaigs.gaussians import SH_DC, Gaussians
from gaigs.io.files import atomic_write
from gaigs.model import Model
from gaigs.registry import name_of, registry
from gaigs.report.shapes import LearntRoom
from gaigs.report.table import metrics_table, verdict
from gaigs.scene import Scene
from gaigs.task import Task

BATCH = 64
"""Links predicted at a time."""

Scores = dict[str, dict[str, Tensor]]
"""Scores of every link, by the model's name and the score's."""


def baseline_configurations(configurations: Sequence[Mapping], own: str, scene: Scene) -> dict[str, Mapping]:
    """Configurations of the models that a run is held against, by name; one of its own model's name is left out.

    Raises:
        ValueError: One has no name, an unknown one, or options that do not fit; two have the same name; or one is a
            model that has to be trained.
    """
    found: dict[str, Mapping] = {}
    for config in configurations:
        if not isinstance(config, Mapping) or "name" not in config:
            raise ValueError(f"baselines must be a list of model configurations with a name, got {config!r}")
        name = config["name"]
        if name in found:
            raise ValueError(f"baselines must have different names, got {name!r} twice")
        found[name] = config
        if name == own:
            continue
        if is_trained(registry("model").build(config, scene=scene)):
            raise ValueError(f"baselines are models without a training, and {name!r} has one; take it as model={name}")
    return {name: config for name, config in found.items() if name != own}


def is_trained(model: Model) -> bool:
    """Whether a model has parameters to be trained, beside what ``fit`` takes from the links."""
    return any(parameter.requires_grad for parameter in model.parameters())


def fit(config: Mapping, links: Links) -> Model:
    """A model that learns by ``fit`` alone, fitted."""
    model = registry("model").build(config, scene=links.scene)
    model.fit(links)
    return model


def predict(model: Model, links: Links, index: Int[Tensor, "k"]) -> Tensor:
    """Predictions for some links, on the CPU."""
    return torch.cat([model.predict(links.query[part], batch_size=BATCH).cpu() for part in index.split(BATCH)])


@dataclass(frozen=True)
class Evaluation(JupyterMixin):
    """Scores on the test links; prints as a table, in a notebook too.

    Attributes:
        task: What the labels are, and so what the scores are.
        split: Its name.
        scores: Of every test link (k,), by the model's name and the score's; the evaluated model first.
        device: What the numbers were computed on.
    """

    task: Task
    split: str
    scores: Scores
    device: str

    @property
    def models(self) -> dict[str, dict[str, float]]:
        """The numbers of the table, by the model's name and the metric's."""
        return {name: self.task.summarise(values) for name, values in self.scores.items()}

    def __rich__(self) -> Group:
        facts = {"task": self.task.name, "split": self.split, "device": self.device, "models": self.models}
        return Group(metrics_table(facts), verdict(facts))

    def __str__(self) -> str:
        console = Console(file=io.StringIO(), width=120)
        console.print(self)
        return console.file.getvalue().rstrip()


def evaluate(model: Model, links: Links, baselines: Sequence[str | Mapping] | None = None) -> Evaluation:
    """Scores of a model on the test links, beside those of baselines that are fitted to the others.

    Args:
        model: Trained, fitted or loaded, on links of the same receivers and task.
        links: With a split.
        baselines: Names or configurations of models without a training; None is the task's own.

    Raises:
        TypeError: The model is no ``gaigs.Model``, or the links are no ``gaigs.Links``.
        ValueError: The links have no test links, other receivers or another task, or a baseline has to be trained.

    Example:
        >>> links = gaigs.links("synthetic_rssi", transmitters=50)
        >>> result = gaigs.evaluate(gaigs.train("knn", links), links, baselines=["mean", "path_loss"])
        >>> list(result.models)
        ['knn', 'mean', 'path_loss']
        >>> print(result)
        Test scores
        ...
        evaluated on ...
    """
    if not isinstance(model, Model) or not isinstance(links, Links):
        raise TypeError(f"evaluate takes a model and links, got {type(model).__name__} and {type(links).__name__}")
    check_fit(links, model.scene)
    if not len(links.split.test):
        raise ValueError("links must have some to test on; take another split")
    task = links.task
    own, trained = name_of(model), getattr(model, "trend", None)
    models = {own: model}
    if own == "kriging":
        own = name_of(trained)
        models = {own: model, f"{own}_trend": trained}
    if baselines is None:
        baselines = composed([f"task={task.name}"], {})["baselines"] if has_file("task", task.name) else ()
    baselines = [baselines] if isinstance(baselines, str) else baselines
    named = [{"name": baseline} if isinstance(baseline, str) else baseline for baseline in baselines]
    scores = score(models, baseline_configurations(named, own, links.scene), links)
    return Evaluation(task, links.split.name, scores, device_name(device_of(model)))


def score(
    models: Mapping[str, Model], baselines: Mapping[str, Mapping], links: Links, folder: Path | None = None
) -> Scores:
    """Scores of models and their baselines on every test link.

    Args:
        models: By name; the first one's predictions are written.
        baselines: Configurations by name.
        links: All of them.
        folder: Gets ``predictions.npz``; None leaves no file.
    """
    task, index = links.task, links.split.test
    labels = torch.cat([links.labels[part] for part in index.split(BATCH)])
    query = links.query[index]
    content = {
        "link": index.numpy(),
        "transmitters": query.transmitters.numpy(),
        "receiver": query.receivers.numpy(),
        "labels": task.packed(labels),
    }
    if query.frequencies is not None:
        content["frequencies"] = query.frequencies.numpy()
    if task.directions is not None:
        content |= {"elevations": task.directions.elevations.numpy(), "azimuths": task.directions.azimuths.numpy()}
    scores = {}
    for key in [*models, *baselines]:
        values = predict(models[key] if key in models else fit(baselines[key], links), links, index)
        scores[key] = task.scores(labels, values)
        content.setdefault("prediction", task.packed(values))
        content |= {f"{kind}_{key}": array for kind, array in task.stored(labels, values, scores[key]).items()}
    if folder is not None:
        with atomic_write(folder / "predictions.npz") as part:
            np.savez_compressed(part, **content)
    return scores


def validate(models: Mapping[str, Model], look_ups: Mapping[str, Mapping], links: Links) -> Scores:
    """Scores on the validation links; none where nothing validates.

    Args:
        models: By name; they have not been fitted to these links.
        look_ups: Configurations, by name, of models that learn by ``fit`` alone and are fitted without these links.
        links: All of them.
    """
    split = links.split
    if not len(split.validation):
        return {}
    unseen = replace(links, split=Split(split.name, split.train, split.validation[:0], split.validation))
    labels = torch.cat([links.labels[part] for part in split.validation.split(BATCH)])
    scores = {}
    for name in [*models, *look_ups]:
        fitted = models[name] if name in models else fit(look_ups[name], unseen)
        scores[name] = links.task.scores(labels, predict(fitted, unseen, split.validation))
    return scores


def by_receiver(scores: Scores, links: Links) -> dict[str, dict]:
    """The numbers of a table for each receiver that has test links, by its name and the model's."""
    receivers = links.query.receivers[links.split.test]
    return {
        receiver.name: {
            name: links.task.summarise({key: score[receivers == i] for key, score in values.items()})
            for name, values in scores.items()
        }
        for i, receiver in enumerate(links.receivers)
        if (receivers == i).any()
    }


def inference_ms(model: Model, links: Links) -> float:
    """Milliseconds from a query to its value, everything included."""
    query = links.query[links.split.test[:1]]
    return median_ms(lambda: model.predict(query))


def render_ms(model: Model, links: Links) -> float | None:
    """Milliseconds of rendering alone; None for a model that renders nothing."""
    work = model.rendering(links.batch(links.split.test[:1]).to(device_of(model)))
    if work is None:
        return None
    with torch.no_grad():
        return median_ms(work)


def median_ms(work: Callable, warm_up: int = 5, repeats: int = 25) -> float:
    """Median duration of a call [ms], after warm-up."""
    wait = torch.cuda.synchronize if torch.cuda.is_available() else lambda: None
    seconds = []
    for _ in range(warm_up + repeats):
        wait()
        start = time.perf_counter()
        work()
        wait()
        seconds.append(time.perf_counter() - start)
    return 1e3 * statistics.median(seconds[warm_up:])


def device_of(model: Model) -> torch.device:
    """Where a model computes."""
    return next((tensor.device for tensor in model.state_dict().values()), torch.device("cpu"))


def device_name(device: torch.device) -> str:
    """What the numbers were computed on."""
    if device.type == "cuda":
        return torch.cuda.get_device_name(device)
    info = Path("/proc/cpuinfo")
    lines = info.read_text().splitlines() if info.is_file() else []
    names = [line.split(":")[1].strip() for line in lines if line.startswith("model name")]
    threads = torch.get_num_threads()
    return f"{names[0] if names else platform.processor() or platform.machine()}, {threads} thread{'s' * (threads > 1)}"


def write_figures(
    folder: Path, links: Links, gaussians: Gaussians | None, learnt: LearntRoom | None = None
) -> list[Path]:
    """Draws a run: its room, its losses, and what its task shows of the predictions.

    Args:
        folder: Of the run. What ``test`` and the task wrote is read from it, and ``log/*/metrics.csv`` where the model
            was trained; the figures go to ``figures/``.
        links: What the run was trained and tested on.
        gaussians: The Gaussians it learnt; None for a model without.
        learnt: What it learnt of the room; None for a model that learns nothing of it.

    Returns:
        The files, as PNG.

    Raises:
        FileNotFoundError: The folder lacks what its task draws from.
    """
    from gaigs.report.curves import loss_curves, read_curves  # matplotlib is slow to import
    from gaigs.report.room import paths
    from gaigs.report.style import DPI

    figures = {"room": _room(links, gaussians, learnt)}
    if learnt is not None and learnt.paths:
        figures["paths"] = paths(learnt, _positions(links), links.edges.numpy())
    if losses := sorted(folder.glob("log/*/metrics.csv"), key=lambda file: file.stat().st_mtime):
        figures["loss"] = loss_curves(read_curves(losses))
    figures |= links.task.figures(folder, links)
    (folder / "figures").mkdir(exist_ok=True)
    files = {folder / "figures" / f"{name}.png": figure for name, figure in figures.items()}
    for file, figure in files.items():
        with atomic_write(file) as part:
            figure.savefig(part, dpi=DPI)
    return list(files)


@torch.no_grad()
def _room(links: Links, gaussians: Gaussians | None, learnt: LearntRoom | None):
    from gaigs.report.room import Cloud, room

    poses = [receiver.pose for receiver in links.receivers]
    rotations = np.stack([pose.rotation.numpy() for pose in poses])
    has_axes = [len(receiver.array) > 1 or links.task.directions is not None for receiver in links.receivers]
    cloud = None
    if gaussians is not None:
        strengths = gaussians.opacities * SH_DC * gaussians.signal[..., 0].norm(dim=-1)
        cloud = Cloud(*(values.cpu().numpy() for values in (gaussians.means, gaussians.covariances, strengths)))
    places = links.query.transmitters
    return room(
        places[links.split.train].numpy(),
        places[links.split.test].numpy(),
        _positions(links),
        rotations if all(has_axes) else rotations[:0],
        links.edges.numpy(),
        cloud,
        learnt,
    )


def _positions(links: Links) -> np.ndarray:
    """Where the receivers stand [m]."""
    return np.stack([receiver.pose.position.numpy() for receiver in links.receivers])
