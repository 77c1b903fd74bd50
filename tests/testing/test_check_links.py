"""Checks of data, splits and tasks find what is broken; and the made-up links keep all of them."""

from dataclasses import replace

import pytest
import torch

from gaigs.antenna import Receiver
from gaigs.data import Split
from gaigs.geometry import Pose, Rays
from gaigs.query import Query
from gaigs.registry import registry
from gaigs.task.csi import Csi
from gaigs.task.rssi import Rssi
from gaigs.task.spectrum import Spectrum
from gaigs.testing import check_data, check_split, check_task, example_links

LINKS = example_links()
MIRROR = Pose(torch.zeros(3), torch.diag(torch.tensor([1.0, 1.0, -1.0])))


def asked(**changes):
    return {"query": replace(LINKS.query, **changes)}


# --- links ---


@pytest.mark.parametrize("task", ["spectrum", "rssi", "csi"])
def test_example_links_keep_the_contract(task):
    links = example_links(task)
    assert len(links) == 24
    assert links.task.name == task
    check_data(links)
    check_data(replace(links, split=None))
    same = example_links(task)
    assert torch.equal(links.labels, same.labels)
    assert torch.equal(links.query.transmitters, same.query.transmitters)


@pytest.mark.parametrize("task", ["spectrum", "rssi", "csi"])
def test_example_links_of_a_known_carrier_keep_the_contract(task):
    links = example_links(task, 5e9)
    check_data(links)
    assert links.scene.frequencies.tolist() == [5e9]
    assert links.scene.bandwidth == 5e8
    assert torch.equal(links.query.transmitters, example_links(task).query.transmitters)
    assert len(links.receivers[0].array) == {"spectrum": 9, "rssi": 1, "csi": 4}[task]


def test_other_examples_are_refused():
    with pytest.raises(ValueError, match="spectrum, rssi or csi, got 'odour'"):
        example_links("odour")


def test_the_channels_of_the_example_follow_the_direct_path():
    """Their phase turns with the frequency as the distance says: by 2 pi f d / c, sign minus."""
    links = example_links("csi")
    for k in range(24):
        position = links.receivers[links.query.receivers[k]].pose.position
        distance = (links.query.transmitters[k] - position).double().norm().item()
        slopes = torch.angle((links.labels[k, :, 1:] * links.labels[k, :, :-1].conj()).mean()).item()
        steps = links.task.frequencies.diff()[0].item()
        assert abs(slopes + 2 * torch.pi * steps * distance / 299_792_458) < 0.5


def tell(links):
    """Links whose labels change from one reading to the next."""

    class Restless:
        def __getitem__(self, index):
            return torch.rand(len(index), *links.task.shape)

    return replace(links, labels=Restless())


def relative(links):
    """Links whose labels are scaled by the others that are asked for."""

    class Relative:
        def __getitem__(self, index):
            return links.labels[index] * links.labels[index].mean()

    return replace(links, labels=Relative())


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (asked(transmitters=torch.zeros(24, 3, dtype=torch.float64)), "transmitters must be torch.float32"),
        (asked(transmitters=torch.full((24, 3), torch.nan)), "transmitters must be finite"),
        (asked(receivers=torch.full((24,), 2)), "the query must point into receivers"),
        (asked(receivers=torch.zeros(24)), "receivers must hold an integer for each link"),
        (asked(frequencies=torch.full((24,), 2.4)), r"frequencies must be from 10000 to 3e\+11 Hz"),
        (asked(frequencies=torch.full((24,), 920e9)), r"frequencies must be from 10000 to 3e\+11 Hz"),
        (asked(frequencies=torch.ones(23)), r"frequencies must be of shape \(24,\), got \(23,\)"),
        (asked(frequencies=torch.ones(24, dtype=torch.long)), r"frequencies must be floats \[Hz\]"),
        ({"receivers": (Receiver("one", MIRROR), LINKS.receivers[1])}, "the rotation of one must not mirror"),
        ({"receivers": LINKS.receivers[:1] * 2}, "receivers must have different names"),
        ({"rows": torch.zeros(24).long()}, "links of one row must have the transmitter's place in common"),
        ({"rows": torch.arange(23)}, "rows must hold an integer for each link"),
        ({"rows": -torch.arange(24)}, "rows must count from 0"),
        ({"official": lambda: (torch.arange(20), torch.arange(19, 24))}, "no link may stand twice in train, test"),
        ({"official": lambda: (torch.arange(20).flip(0), torch.arange(20, 24))}, "train must ascend"),
        ({"official": lambda: (torch.arange(20), torch.arange(0))}, "leave links to train and to test on"),
        ({"labels": torch.full((24, 18, 36), 1.5)}, r"spectra must lie in \[0, 1\]"),
        ({"labels": torch.zeros(24, 36, 18)}, r"labels must be of shape \(9, 18, 36\), got \(9, 36, 18\)"),
        ({"labels": torch.zeros(24, 18, 36, dtype=torch.float64)}, "labels must be torch.float32"),
        ({"split": replace(LINKS.split, test=torch.arange(3))}, "no link may stand twice"),
        ({"split": replace(LINKS.split, test=torch.arange(24, 26))}, "must point at the 24 links"),
    ],
)
def test_broken_links_are_found(changes, message):
    with pytest.raises(AssertionError, match=message):
        check_data(replace(LINKS, **changes))


def test_labels_that_change_are_found():
    with pytest.raises(AssertionError, match="labels asked for twice must be the same"):
        check_data(tell(LINKS))
    with pytest.raises(AssertionError, match="a label must not depend on which others are asked for"):
        check_data(relative(LINKS))


def test_an_official_split_whose_files_are_missing_hurts_only_who_asks_for_it():
    def read():
        raise FileNotFoundError("train_index.txt")

    check_data(replace(LINKS, official=read))


# --- splits ---


def taking(choose):
    """A split of the RSSI's links by a function of their number and the seed, and the name of the seed."""

    def build(seed):
        test = choose(torch.Generator().manual_seed(seed))
        rest = torch.tensor(sorted({*range(24)} - {*test.tolist()}))
        return Split(f"broken, seed {seed}", rest, rest[:0], test)

    return build


def whole_rows(generator):
    rows = torch.randperm(12, generator=generator)[:3].sort().values
    return (2 * rows[:, None] + torch.arange(2)).flatten()


def overlapping(seed):
    split = taking(whole_rows)(seed)
    return replace(split, validation=split.train[:2])


def unnamed(seed):
    return replace(taking(whole_rows)(seed), name="broken")


def forgetful(seed):
    return taking(lambda _: whole_rows(torch.Generator().manual_seed(int(torch.randint(1000, ())))))(seed)


@pytest.mark.parametrize(
    ("build", "message"),
    [
        (taking(lambda g: torch.randperm(24, generator=g)[:6].sort().values), "links of one row must be in one"),
        (taking(lambda g: whole_rows(g).flip(0)), "test must ascend"),
        (taking(lambda g: torch.arange(4)), "another seed must give another split"),
        (overlapping, "no link may stand twice in train, validation, test"),
        (unnamed, "a split's name must differ between seeds"),
        (forgetful, "the same seed must give the same split in any random state"),
    ],
)
def test_a_broken_split_is_found(build, message):
    check_split(taking(whole_rows), example_links("rssi"))
    with pytest.raises(AssertionError, match=message):
        check_split(build, example_links("rssi"))


def test_parts_that_came_with_the_data_may_part_rows():
    build = taking(lambda g: torch.randperm(24, generator=g)[:6].sort().values)
    check_split(build, example_links("rssi"), parts_rows=True)


# --- tasks ---


class Biased(Rssi):
    def scores(self, labels, values):
        return super().scores(labels, values - 0.5)


class Upside(Rssi):
    higher_is_better = True


class Pooled(Rssi):
    def scores(self, labels, values):
        scores = super().scores(labels, values)
        return {name: score + 1e-3 * score.mean() for name, score in scores.items()}


class Trusting(Rssi):
    def scores(self, labels, values):
        return {self.monitor: (values - labels).detach().double().abs()}


class Blind(Csi):
    """A score that does not see that a prediction is NaN."""

    def scores(self, labels, values):
        return super().scores(labels, torch.where(values.isnan(), 0, values))


class Cheerful(Rssi):
    def summarise(self, scores):
        return super().summarise(scores) if len(scores[self.monitor]) else dict.fromkeys(self.metrics(), 0.0)


class Renamed(Rssi):
    def summarise(self, scores):
        return {f"{name}_db": number for name, number in super().summarise(scores).items()}


class Amnesic(Spectrum):
    def options(self):
        return super().options() | {"normalisation": "forgotten"}


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
        return lambda batch, generator: thin(batch, torch.Generator().manual_seed(int(torch.randint(10**6, ()))))


GRID = LINKS.task.directions
SPECTRUM = GRID.elevations, GRID.azimuths, "none"


@pytest.mark.parametrize(
    ("task", "message"),
    [
        (Biased(), "true values must score best"),
        (Upside(), "true values must score best"),
        (Pooled(), "the score mae_db must not depend on the other samples"),
        (Trusting(), "values of different number must be a ValueError"),
        (Blind(2, torch.tensor([1e9, 2e9])), "values that are NaN must be a ValueError"),
        (Cheerful(), "a summary of no samples must be a ValueError"),
        (Renamed(), "summarise must give mae_db, median_ae_db, rmse_db, got mae_db_db"),
        (Amnesic(*SPECTRUM), "the task's state must restore it"),
        (Parted(*SPECTRUM), "labels and directions must be thinned together"),
        (Careless(*SPECTRUM), "only the generator may decide the thinning"),
    ],
)
def test_a_broken_task_is_found(task, message, monkeypatch):
    thinnings = [{"rays": 20}] if isinstance(task, Spectrum) else []
    # As if it were registered, so that it comes back as itself.
    monkeypatch.setattr(registry("task"), "get", lambda name: type(task))
    with pytest.raises(AssertionError, match=message):
        check_task(task, *thinnings)


def test_a_task_under_a_name_of_nobody_is_found():
    class Nameless(Rssi):
        name = "nobody's"

    with pytest.raises(AssertionError, match='a task must bear its registered name, got "nobody\'s"'):
        check_task(Nameless())


@pytest.mark.parametrize("task", ["spectrum", "rssi", "csi"])
def test_the_tasks_of_the_example_keep_the_contract(task):
    check_task(example_links(task).task)
    assert isinstance(example_links(task).query, Query)
