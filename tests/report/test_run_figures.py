"""All figures of a run: files and their data."""

import csv

import numpy as np
import pytest
import torch
from matplotlib import image

from gaigs.core import stages
from gaigs.core.antenna import Array, Receiver
from gaigs.core.geometry import Grid, Pose
from gaigs.core.query import Query
from gaigs.core.radio_maps import RadioMap
from gaigs.core.task.csi import Csi
from gaigs.core.task.rssi import Rssi
from gaigs.core.task.spectrum import Spectrum
from gaigs.data import Links, Split
from gaigs.model import Model
from gaigs.planes.learnt_room import LearntRoom
from gaigs.planes.room_paths import LearntPath
from gaigs.report import csi, figures, radio_maps, run_figures, scalar, spectrum
from gaigs.report.run_figures import figures_of, write_figures
from gaigs.splatting.gaussians import Gaussians

GRID = Grid.degrees(range(10, 91, 10), range(0, 360, 15))


class Untrained(Model):
    """A model with the Gaussians and the learnt room of a test, if any."""

    primitives = None

    def __init__(self, scene, primitives=None, room=None):
        super().__init__(scene)
        self.primitives = primitives
        if room is not None:
            self.learnt_room = lambda links: room

    def forward(self, batch):
        raise NotImplementedError


@pytest.fixture
def rng():
    return np.random.default_rng(5)


@pytest.fixture
def spy(monkeypatch):
    """Notes the arguments and the figure of a drawing function."""

    def watch(module, name):
        shown, original = [], getattr(module, name)

        def noted(*args, **options):
            shown.append((args, original(*args, **options)))
            return shown[-1][1]

        monkeypatch.setattr(module, name, noted)
        return shown

    return watch


def written(folder, links, model=None):
    """Names of the figures; each has something drawn on white."""
    files = write_figures(folder, links, model or Untrained(links.scene))
    for file in files:
        assert file.parent == folder / "figures"
        assert image.imread(file)[..., :3].std() > 0.02
    return {file.stem for file in files}


@pytest.fixture
def spectrum_links():
    generator = torch.Generator().manual_seed(1)
    query = Query(torch.rand(12, 3, generator=generator), torch.zeros(12, dtype=torch.long))
    pose = Pose.from_xyzw([3.0, 0, 1], [0.0, 0, 0, 1])
    split = Split(
        "runs of 4", torch.arange(8), torch.tensor([], dtype=torch.long), torch.arange(8, 12)
    )
    task = Spectrum(GRID.elevations, GRID.azimuths, "min-max")
    labels = torch.rand(12, *task.shape, generator=generator)
    return Links(query, (Receiver("array", pose),), labels, task, split=split)


def write_losses(path, steps=30):
    path.parent.mkdir(parents=True)
    with open(path, "w", newline="") as file:
        writer = csv.DictWriter(file, ["epoch", "step", "train/loss", "validation/ssim"])
        writer.writeheader()
        writer.writerows(
            {"epoch": 0, "step": k, "train/loss": 1 / (k + 1), "validation/ssim": k}
            for k in range(steps)
        )


def test_a_run_is_drawn_into_its_folder(pixels, spectrum_links, tmp_path, rng):
    test = spectrum_links.split.test
    labels = spectrum_links.labels[test].numpy().astype(np.float16)
    ssim = {f"ssim_{model}": rng.random(4) for model in ("gaigs", "mean", "knn")}
    np.savez(
        tmp_path / "predictions.npz", labels=labels, prediction=labels[::-1], link=test, **ssim
    )
    write_losses(tmp_path / "log" / "version_0" / "metrics.csv")
    torch.manual_seed(0)
    start = {"count": 30, "near": 0.5, "far": 3, "spread": 1, "opacity": 0.5, "signal": 0.1}
    model = Untrained(
        spectrum_links.scene, Gaussians(spectrum_links.scene, zone=(0.1, 1.5), channels=2, **start)
    )
    assert written(tmp_path, spectrum_links, model) == {
        "room",
        "loss",
        "spectra",
        "spectra_polar",
        "ssim_cdf",
    }


def test_examples_are_at_their_percentiles_of_the_own_model(spectrum_links, tmp_path, rng, spy):
    labels = rng.random((41, 9, 24)).astype(np.float16)
    own = rng.permutation(np.linspace(0, 0.8, 41))
    np.savez(
        tmp_path / "predictions.npz",
        labels=labels,
        prediction=1 - labels,
        ssim_gaigs=own,
        ssim_knn=own[::-1],
    )
    shown = spy(spectrum, "spectra")
    figures_of(Spectrum).of_run(spectrum_links.task, tmp_path, spectrum_links)
    drawn_labels, drawn_predictions, ssim, names = shown[0][0][0]
    assert dict(zip(names, ssim, strict=True)) == pytest.approx(
        {"10th percentile": 0.08, "median": 0.4, "90th percentile": 0.72}
    )
    np.testing.assert_array_equal(drawn_labels[1], labels[np.argsort(own)[20]])
    np.testing.assert_array_equal(drawn_predictions, 1 - drawn_labels)


def test_the_learnt_room_is_drawn(spectrum_links, tmp_path, spy):
    labels = spectrum_links.labels[spectrum_links.split.test].numpy().astype(np.float16)
    np.savez(
        tmp_path / "predictions.npz",
        labels=labels[:1],
        prediction=labels[:1],
        ssim_mirrored=np.ones(1),
    )
    seen, folded = spy(run_figures, "room"), spy(run_figures, "paths")
    learnt = LearntRoom([], None, [LearntPath(np.array([[1.0, 1, 1], [3, 0, 1]]), 0.0)])
    model = Untrained(spectrum_links.scene, room=learnt)
    names = {file.stem for file in write_figures(tmp_path, spectrum_links, model)}
    assert names == {"room", "paths", "spectra", "spectra_polar", "ssim_cdf"}
    assert seen[0][0] == (spectrum_links, None, learnt)
    assert folded[0][0] == (spectrum_links, learnt)
    model = Untrained(
        spectrum_links.scene, room=learnt._replace(paths=[])
    )  # of a transmitter that nobody hears
    assert "paths" not in {file.stem for file in write_figures(tmp_path, spectrum_links, model)}


def test_figures_that_have_no_time_are_named(spectrum_links, tmp_path, monkeypatch):
    labels = spectrum_links.labels[spectrum_links.split.test].numpy().astype(np.float16)
    np.savez(
        tmp_path / "predictions.npz", labels=labels[:1], prediction=labels[:1], ssim_mean=np.ones(1)
    )
    monkeypatch.setattr(stages, "is_up", iter([False, True]).__next__)
    with stages.watched() as watch:
        files = write_figures(tmp_path, spectrum_links, Untrained(spectrum_links.scene))
    assert [file.name for file in files] == ["room.png"]
    assert watch.left_out == ["no figures spectra, spectra_polar, ssim_cdf"]


@pytest.fixture
def rssi_run(tmp_path):
    """Links of eight gateways and the folder of a run on them."""
    rng = np.random.default_rng(8)
    count = 8
    poses = [Pose(torch.tensor([float(i), 0, 2]), torch.eye(3)) for i in range(count)]
    receivers = tuple(Receiver(f"g{i}", pose) for i, pose in enumerate(poses))
    query = Query(torch.rand(160, 3) * torch.tensor([8.0, 4, 1]), torch.arange(160) % count)
    labels = torch.linspace(-80, -50, 160)
    split = Split(
        "random", torch.arange(80), torch.zeros(0, dtype=torch.long), torch.arange(80, 160)
    )
    links = Links(query, receivers, labels, Rssi(), split=split)
    test = split.test.numpy()
    errors = {
        name: rng.normal(0, scale, 80) for name, scale in (("gaigs", 2), ("mean", 6), ("knn", 3))
    }
    np.savez(
        tmp_path / "predictions.npz",
        link=test,
        transmitters=query.transmitters[test].numpy(),
        receiver=test % count,
        labels=labels[test].numpy(),
        prediction=labels[test].numpy() + errors["gaigs"],
        **{f"error_{name}": error for name, error in errors.items()},
    )
    names = tuple(receiver.name for receiver in receivers)
    maps = RadioMap(
        rng.uniform(-80, -50, (count, 9, 17)), 0.5 * np.arange(17), 0.5 * np.arange(9), 0.5, names
    )
    maps.save(tmp_path / "radio_map.npz")
    return links, tmp_path, errors


def test_an_rssi_run_is_drawn_into_its_folder(pixels, rssi_run, spy):
    links, folder, errors = rssi_run
    distributed, mapped, seen = (
        spy(scalar, "cdf"),
        spy(radio_maps, "radio_maps"),
        spy(run_figures, "room"),
    )
    paged = ("predicted_against_measured", "radio_map")
    assert written(folder, links) == {"room", "error_cdf", *paged}
    (absolute, *_), drawn = distributed[0]
    assert list(absolute) == ["gaigs", "mean", "knn"]
    np.testing.assert_allclose(absolute["mean"], np.abs(errors["mean"]))
    (ax,) = drawn.axes
    assert ax.get_xlim() == (0, pytest.approx(np.quantile(np.abs(errors["mean"]), 0.99)))
    assert ax.get_xlabel() == "|error| [dB]"
    assert ax.get_ylabel() == "share of 80 test readings"
    _, gateways, readings, *_ = mapped[0][0]
    assert gateways["g3"].tolist() == [3, 0, 2]
    third = links.split.test[links.split.test % 8 == 3]
    np.testing.assert_allclose(readings["g3"][:, :2], links.query.transmitters[third, :2])
    np.testing.assert_allclose(readings["g3"][:, 2], links.labels[third])
    plan = seen[0][1].axes[0]
    assert not plan.texts  # gateways have no axes to show
    assert len(plan.lines[2].get_xdata()) == 8
    (folder / "radio_map.npz").unlink()
    with pytest.raises(FileNotFoundError, match=r"radio_map\.npz"):
        written(folder, links)


@pytest.mark.parametrize("subcarriers", [1, 16])
def test_a_run_of_channels_is_drawn(pixels, tmp_path, rng, spy, subcarriers):
    frequencies = 2.4e9 + 1e6 * torch.arange(subcarriers, dtype=torch.float64)
    task = Csi(4, frequencies)
    pose, array = Pose.from_xyzw([3.0, 0, 1], [0.0, 0, 0, 1]), Array.planar(2, 2, 0.06)
    split = Split(
        "official", torch.arange(8), torch.tensor([], dtype=torch.long), torch.arange(8, 29)
    )
    query = Query(torch.rand(29, 3), torch.zeros(29, dtype=torch.long))
    labels = torch.randn(29, *task.shape, dtype=torch.complex64)
    links = Links(query, (Receiver("array", pose, array),), labels, task, split=split)
    own = rng.permutation(np.linspace(-10, 30, 21))
    test = labels[split.test].numpy()
    stored = {"snr_db_gaigs": own, "snr_db_knn": own[::-1]}
    for name, error in (("gaigs", 2.0), ("gaigs_trend", 1.0), ("knn", 3.0), ("mean", 4.0)):
        stored |= {
            f"error_power_{name}": np.full(21, error),
            f"label_power_{name}": np.full(21, 20.0),
        }
    np.savez(tmp_path / "predictions.npz", labels=test, prediction=1j * test, **stored)
    errors, shown = spy(csi, "error_against_power"), spy(csi, "magnitudes_and_phases")
    responses = {"impulse_response"} if subcarriers > 1 else set()
    assert written(tmp_path, links) == {"room", "channels", "snr_cdf", "error_power"} | responses
    (ax,) = errors[0][1].axes
    assert [text.get_text() for text in ax.get_legend().get_texts()] == [
        "SNR 0 dB", "gaigs, NMSE -10.0 dB", "knn, NMSE -8.2 dB"
    ]  # fmt: skip
    (drawn_labels, drawn_predictions, snr, names), drawn_frequencies = shown[0][0]
    assert dict(zip(names, snr, strict=True)) == pytest.approx(
        {"10th percentile": -6, "median": 10, "90th percentile": 26}
    )
    np.testing.assert_array_equal(drawn_labels[2], test[np.argsort(own)[18]])
    np.testing.assert_array_equal(drawn_predictions, 1j * drawn_labels)
    np.testing.assert_array_equal(drawn_frequencies, frequencies)


class Level(Rssi):
    """A plug-in's task of its own."""


class Direction(Spectrum.__base__):
    """A task without figures."""


def test_figures_are_registered_for_a_task_and_its_subclasses(monkeypatch):
    assert type(figures_of(Level)) is scalar.ScalarFigures
    assert type(figures_of(Direction)) is figures.TaskFigures
    monkeypatch.setattr(figures, "registered", {})

    @figures.register(Level)
    class LevelFigures(figures.TaskFigures):
        pass

    assert type(figures_of(type("Louder", (Level,), {}))) is LevelFigures
    assert type(figures_of(Rssi)) is scalar.ScalarFigures
