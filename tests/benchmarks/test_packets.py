"""The converter of ultra-wideband packets, on invented taps."""

import numpy as np
import pytest
import torch
from packets import convert

from gaigs.core.task.csi import Csi
from gaigs.data import load

BANDWIDTH = 500e6
SPACING = 1 / 998.4e6


def receive(noises, places=3, seed=0):
    """Packets of three paths from some places, one for each standard deviation of the noise; gains
    and delays [s] of the paths.
    """
    draw = np.random.default_rng(seed)
    gains = draw.normal(size=(places, 3)) + 1j * draw.normal(size=(places, 3))
    gains[:, 0] += 3
    delays = np.sort(draw.uniform(0, 60e-9, (places, 3)), 1)
    delays -= delays[:, :1]
    which = np.repeat(np.arange(places), len(noises))
    first = draw.uniform(40, 60, len(which))
    times = (np.arange(250) - first[:, None]) * SPACING  # (n, t) [s]
    pulses = np.sinc(BANDWIDTH * (times[:, :, None] - delays[which][:, None]))
    taps = (pulses * gains[which][:, None]).sum(2)
    noise = np.tile(noises, places)
    parts = draw.normal(size=(2, *taps.shape)) / 2**0.5
    taps = taps + noise[:, None] * (parts[0] + 1j * parts[1])
    turns = np.exp(2j * np.pi * draw.uniform(size=len(which)))
    scales = draw.uniform(0.3, 3, len(which))
    content = {
        "taps": taps * (turns * scales)[:, None],
        "first_path": first + draw.uniform(-0.3, 0.3, len(first)),
        "noise": noise * scales,
        "spacing": np.array([SPACING]),
        "carrier": np.array([4e9]),
        "tx": draw.uniform(0, 5, (places, 3))[which],
        "rx": np.array([[1.0, 2.0, 2.0]]),
    }
    return content, gains, delays


def scores(made, content, gains, delays):
    """SNR of the channels after phase, delay and gain [dB]."""
    task = Csi(1, made["frequencies"], "per_link_and_delay")
    turns = delays[..., None] * (made["frequencies"] - 4e9)  # (places, p, s)
    truth = (gains[..., None] * np.exp(-2j * np.pi * turns)).sum(1)
    _, first = np.unique(content["tx"], axis=0, return_index=True)  # the order of the links
    order = first // (len(content["tx"]) // len(gains))
    labels = torch.from_numpy(truth[order])[:, None].to(torch.complex64)
    values = torch.from_numpy(made["h"]).to(torch.complex64)
    return task.scores(labels, values)["snr_aligned_db"]


def test_taps_become_the_channel():
    received = receive([0.0, 0.0])
    made = convert(received[0], BANDWIDTH)
    assert made["h"].shape[:2] == (3, 1)
    assert made["frequencies"].mean() == pytest.approx(4e9)
    # Pulses do not end, so the band's edges and the window cost some decibels.
    assert scores(made, *received).min() > 14


@pytest.mark.parametrize("has_noise", [True, False])
def test_packets_with_less_noise_count_more(has_noise):
    received = receive([0.1] * 5 + [3.0] * 5)
    content = received[0]
    if not has_noise:
        del content["noise"]
    weighted = scores(convert(content, BANDWIDTH), *received)
    alike = content | {"noise": np.full(30, 0.1)}
    assert weighted.min() > 12
    assert (weighted > scores(convert(alike, BANDWIDTH), *received)).all()


def test_links_of_the_file_are_read(tmp_path):
    content, *_ = receive([0.1] * 4, places=6)
    content["rx"] = np.array([[1.0, 2.0, 2.0], [4.0, 0.0, 2.0]])
    content["rx_index"] = np.repeat([0, 1], 12)
    np.savez(tmp_path / "room.npz", **convert(content, BANDWIDTH))
    data = {"name": "csi_npz", "file": str(tmp_path / "room.npz"), "phase": "per_link_and_delay"}
    links = load(data, {"name": "random", "test": 0.3, "validation": 0}, is_checked=False)
    assert len(links) == 6
    assert links.query.receivers.bincount().tolist() == [3, 3]


def test_channels_are_averaged_too():
    draw = np.random.default_rng(0)
    truth = draw.normal(size=(2, 1, 20)) + 1j * draw.normal(size=(2, 1, 20))
    turned = truth.repeat(8, 0) * np.exp(2j * np.pi * draw.uniform(size=(16, 1, 1)))
    noise = 0.3 * (draw.normal(size=turned.shape) + 1j * draw.normal(size=turned.shape))
    places = np.array([[0.0, 0, 0], [1.0, 0, 0]]).repeat(8, 0)
    content = {"h": turned + noise, "frequencies": np.linspace(4e9, 4.2e9, 20), "tx": places}
    made = convert(content | {"rx": np.zeros((1, 3))}, BANDWIDTH)
    task = Csi(1, made["frequencies"], "per_link")
    found = task.scores(
        torch.from_numpy(truth).to(torch.complex64), torch.from_numpy(made["h"]).to(torch.complex64)
    )
    assert found["snr_aligned_db"].min() > 13, "a single packet has 10.4 dB"


def test_shapes_are_checked():
    content, *_ = receive([0.0])
    with pytest.raises(ValueError, match=r"taps \(n, t\) and first_path"):
        convert(content | {"first_path": np.zeros(2)}, BANDWIDTH)
