"""The checks of data, tasks and models find faults; the example links keep their contracts."""

from dataclasses import replace

import pytest
import torch
from contracts.faults import broken, having
from torch import nn

from gaigs.core.geometry import Rays
from gaigs.core.query import Query
from gaigs.core.task.csi import Csi
from gaigs.core.task.rssi import Rssi
from gaigs.core.task.spectrum import Spectrum
from gaigs.io.images import GreyImages
from gaigs.model import Model, Prediction
from gaigs.registry import registry
from gaigs.testing import check_data, check_model, check_task, example_links

LINKS, RSSI = example_links(), example_links("rssi")


# --- links ---


@pytest.mark.parametrize("carrier", [None, 5e9])
@pytest.mark.parametrize("task", ["spectrum", "rssi", "csi"])
def test_example_links_keep_the_contract(task, carrier):
    links, same = example_links(task, carrier), example_links(task)
    check_data(links)
    check_data(replace(links, split=None))
    check_task(links.task)
    assert torch.equal(links.query.transmitters, same.query.transmitters)
    assert links.scene.frequencies.tolist() == ([] if carrier is None else [5e9])
    assert links.scene.bandwidth == (None if carrier is None else 5e8)


def test_other_examples_are_refused():
    with pytest.raises(ValueError, match="spectrum, rssi or csi, got 'odour'"):
        example_links("odour")


def test_the_channels_of_the_example_follow_the_direct_path():
    """Their phase turns with the frequency as the distance says: by 2 pi f d / c, sign minus."""
    links = example_links("csi")
    for k in range(24):
        position = links.receivers[links.query.receivers[k]].pose.position
        distance = (links.query.transmitters[k] - position).double().norm().item()
        slopes = torch.angle(
            (links.labels[k, :, 1:] * links.labels[k, :, :-1].conj()).mean()
        ).item()
        steps = links.task.frequencies.diff()[0].item()
        assert abs(slopes + 2 * torch.pi * steps * distance / 299_792_458) < 0.5


class Labels(GreyImages):
    """Labels by a function of the numbers of the links."""

    def __init__(self, read):
        self.read = read

    def __getitem__(self, index):
        return self.read(index)


def with_query(**changes):
    return {"query": replace(LINKS.query, **changes)}


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (
            with_query(transmitters=torch.zeros(24, 3, dtype=torch.float64)),
            "transmitters must be torch.float32",
        ),
        (with_query(transmitters=torch.full((24, 3), torch.nan)), "transmitters must be finite"),
        (with_query(receivers=torch.full((24,), 2)), "the query must point into receivers"),
        (
            with_query(frequencies=torch.full((24,), 2.4)),
            r"frequencies must be from 10000 to 3e\+11 Hz",
        ),
        ({"receivers": LINKS.receivers[:1] * 2}, "receivers must have different names"),
        ({"rows": torch.zeros(24).long()}, "links of one row must have one transmitter position"),
        ({"rows": -torch.arange(24)}, "rows must count from 0"),
        (
            {"official": lambda: (torch.arange(20), torch.arange(19, 24))},
            "no link may stand twice in train, test",
        ),
        (
            {"official": lambda: (torch.arange(20).flip(0), torch.arange(20, 24))},
            "train must ascend",
        ),
        (
            {"official": lambda: (torch.arange(20), torch.arange(0))},
            "leave links to train and to test on",
        ),
        ({"labels": torch.full((24, 18, 36), 1.5)}, r"spectra must lie in \[0, 1\]"),
        (
            {"labels": torch.zeros(24, 36, 18)},
            r"labels must be of shape \(9, 18, 36\), got \(9, 36, 18\)",
        ),
        ({"labels": torch.zeros(24, 18, 36, dtype=torch.float64)}, "labels must be torch.float32"),
        (
            {"labels": Labels(lambda i: torch.rand(len(i), 18, 36))},
            "labels read twice must be the same",
        ),
        (
            {"labels": Labels(lambda i: LINKS.labels[i] * LINKS.labels[i].mean())},
            "must not depend on the others",
        ),
        ({"split": replace(LINKS.split, test=torch.arange(3))}, "no link may stand twice"),
        ({"split": replace(LINKS.split, test=torch.arange(24, 26))}, "must point at the 24 links"),
    ],
)
def test_faulty_links_are_found(changes, message):
    with pytest.raises(AssertionError, match=message):
        check_data(replace(LINKS, **changes))


def test_a_missing_index_file_prevents_the_official_split_only():
    def read():
        raise FileNotFoundError("train_index.txt")

    check_data(replace(LINKS, official=read))


# --- tasks ---


def pooled(scores, *_):
    return {name: score + 1e-3 * score.mean() for name, score in scores.items()}


def blind(self, labels, values):
    """Scores that do not see that a prediction is NaN."""
    return Csi.scores(self, labels, torch.where(values.isnan(), 0, values))


def cheerful(self, scores):
    return (
        Rssi.summarise(self, scores)
        if len(scores[self.monitor])
        else dict.fromkeys(self.metrics(), 0.0)
    )


class Parted(Spectrum):
    """Thins labels and directions by other pixels."""

    def thinning(self, rays=None):
        thin = super().thinning(rays=rays)

        def parted(batch, generator):
            part = thin(batch, generator)
            if isinstance(part.directions, Rays):
                part.labels = part.labels.flip(1)
            return part

        return parted


class Careless(Spectrum):
    """Draws from torch's own generator."""

    def thinning(self, rays=None):
        thin = super().thinning(rays=rays)
        return lambda batch, generator: thin(
            batch, torch.Generator().manual_seed(int(torch.randint(10**6, ())))
        )


SPECTRUM = LINKS.task.directions.elevations, LINKS.task.directions.azimuths, "none"


@pytest.mark.parametrize(
    ("task", "message"),
    [
        (
            having(
                Rssi, scores=lambda self, labels, values: Rssi.scores(self, labels, values - 0.5)
            ),
            "must score best",
        ),
        (having(Rssi, higher_is_better=True), "true values must score best"),
        (broken(Rssi, pooled, "scores"), "the score mae_db must not depend on the other samples"),
        (
            having(
                Rssi,
                scores=lambda self, labels, values: {
                    "mae_db": (values - labels).detach().double().abs()
                },
            ),
            "values of different number must be a ValueError",
        ),
        (having(Csi, scores=blind), "values that are NaN must be a ValueError"),
        (having(Rssi, summarise=cheerful), "a summary of no samples must be a ValueError"),
        (
            broken(
                Rssi,
                lambda numbers, *_: {f"{name}_db": number for name, number in numbers.items()},
                "summarise",
            ),
            "summarise must give some of mae_db, median_ae_db, rmse_db, got mae_db_db",
        ),
        (
            broken(Spectrum, lambda o: o | {"normalisation": "forgotten"}, "options"),
            "task's state must restore it",
        ),
        (Parted, "labels and directions must be thinned together"),
        (Careless, "only the generator may decide the thinning"),
        (having(Rssi, name="nobody's"), 'a task must have its registered name, got "nobody\'s"'),
    ],
)
def test_a_faulty_task_is_found(task, message, monkeypatch):
    options = {Csi: (2, torch.tensor([1e9, 2e9])), Spectrum: SPECTRUM}.get(task.__base__, ())
    # As if it were registered, so that it comes back as itself.
    monkeypatch.setattr(registry("task"), "get", lambda name: task)
    with pytest.raises(AssertionError, match=message):
        check_task(task(*options), *([{"rays": 20}] if issubclass(task, Spectrum) else []))


# --- models ---


class Grey(Model):
    """The same grey in all directions, learnt."""

    level = 1.0

    def __init__(self, scene):
        super().__init__(scene)
        self.grey = nn.Parameter(torch.full((), 0.5))

    def forward(self, batch):
        return Prediction(
            self.level * self.grey * self.grey.new_ones(len(batch), *batch.directions.shape), {}
        )


class Level(Model):
    """One level for each receiver and carrier, learnt."""

    def __init__(self, scene):
        super().__init__(scene)
        self.levels = nn.Parameter(-60.0 - torch.arange(len(scene.receivers)))

    def forward(self, batch):
        levels = self.levels[batch.query.receivers]
        if batch.query.frequencies is not None:
            levels = levels - batch.query.frequencies / 1e9
        return Prediction(levels, {})


def test_sound_models_keep_the_contract():
    check_model(Grey, LINKS)
    check_model(Level, RSSI)
    frequencies = torch.tensor([2.4e9, 5.0e9])[torch.arange(24) // 2 % 2]
    check_model(Level, replace(RSSI, query=replace(RSSI.query, frequencies=frequencies)))


def changed(change, kind=Grey):
    """A model whose value is changed by a function of the value and the batch."""
    return broken(
        kind, lambda prediction, batch: prediction._replace(value=change(prediction.value, batch))
    )


def shaded(value, batch):
    """A gradient by the number of the row."""
    shades = torch.linspace(0, 1, batch.directions.shape[0])
    return value * shades.reshape(-1, *[1] * (value.ndim - 2))


def without_nan(self, transmitters, *others, **options):
    if not isinstance(transmitters, Query):
        transmitters = torch.as_tensor(transmitters).nan_to_num()
    return Model.predict(self, transmitters, *others, **options)


def without_the_last(self, batch):
    value = Model.evaluate(self, batch)
    return (
        value
        if self.chunk is None
        else value * (torch.arange(value.shape[-1]) < value.shape[-1] - 1)
    )


def flat_list(self, places, *_, **options):
    return torch.full((len(places), 18, 36), 0.5)


@pytest.mark.parametrize(
    ("model", "message"),
    [
        (
            having(Grey, parameter_groups=lambda self: {"network": []}),
            "must be in one of parameter_groups",
        ),
        (
            changed(lambda v, batch: v.mean() * v.new_ones(len(batch), 18, 36)),
            "must give the directions",
        ),
        (
            having(Grey, fit=lambda self, links: setattr(self, "level", links.labels.mean())),
            "a model's state dict must restore its predictions",
        ),
        (
            changed(lambda value, batch: value * len(batch)),
            "the batch size must not change predictions",
        ),
        (changed(lambda value, batch: (value * 0).sqrt()), "the gradient of grey must be finite"),
        (having(Grey, predict=flat_list), "a grid of positions must give a grid of predictions"),
        (having(Grey, predict=without_nan), "NaN as a position must be a ValueError"),
        (changed(shaded), "predict must give the directions"),
        (
            changed(lambda value, batch: value * (1 + batch.query.receivers[:1].sum())),
            "links to several receivers must get the values of single links",
        ),
        (having(Grey, facts=lambda self: {"mean": torch.zeros(())}), "facts must be plain values"),
        (
            having(Grey, trained_by="osmosis"),
            "trained_by must be one of .*'descent'.*, got 'osmosis'",
        ),
        (
            broken(
                Grey,
                lambda result, batch: result._replace(
                    penalties={"each": result.value.flatten(1)[:, 0]}
                ),
            ),
            r"the penalty each must be of shape \(\), got \(5,\)",
        ),
        (having(Grey, evaluate=without_the_last), "chunk must not change values"),
        (
            changed(lambda value, batch: value.sort().values, Level),
            "must get the values of single links",
        ),
        (changed(lambda value, batch: value.double(), Level), "predictions must be torch.float32"),
    ],
)
def test_a_faulty_model_is_found(model, message):
    with pytest.raises(AssertionError, match=message):
        check_model(model, RSSI if issubclass(model, Level) else LINKS)
