"""Impulse responses as Sionna RT gives them, read as channels."""

import numpy as np
import pytest
from scipy.constants import speed_of_light

from gaigs.data import csi_npz

CARRIER = 3.5e9


def arrays(moving=4, fixed=2, antennas=3):
    """Three paths, the last one padding, from transmitters of one antenna to receivers of several."""
    draw = np.random.default_rng(0)
    shape = (fixed, antennas, moving, 1, 3)
    a = draw.normal(size=shape) + 1j * draw.normal(size=shape)
    a[..., 2] = 0
    tau = draw.uniform(1e-8, 1e-7, (fixed, moving, 3))
    tau[..., 2] = -1
    return {
        "a": a[..., None].astype(np.complex64),
        "tau": tau.astype(np.float32),
        "tx": draw.uniform(-3, 3, (moving, 3)),
        "rx": draw.uniform(-3, 3, (fixed, 3)),
        "carrier": CARRIER,
        "frequencies": CARRIER + np.array([-1e7, 0.0, 1e7]),
    }


def read(tmp_path, content, **options):
    np.savez(tmp_path / "cir.npz", **content)
    return csi_npz.read(tmp_path / "cir.npz", **options)


def test_channels_are_the_sum_of_the_paths(tmp_path):
    content = arrays()
    links = read(tmp_path, content)
    assert links.labels.shape == (8, 3, 3)
    for link, (tx, rx) in enumerate((tx, rx) for tx in range(4) for rx in range(2)):
        assert (
            links.query.transmitters[link].tolist() == content["tx"][tx].astype(np.float32).tolist()
        )
        assert links.query.receivers[link] == rx
        delays = content["tau"][rx, tx, :2].astype(float)
        waves = np.exp(-2j * np.pi * np.outer(delays, [-1e7, 0, 1e7]))
        np.testing.assert_allclose(
            links.labels[link], content["a"][rx, :, tx, 0, :2, 0] @ waves, rtol=1e-4, atol=1e-5
        )


def test_other_forms_of_the_same_responses_are_read_alike(tmp_path):
    """Users that receive, delays of each antenna, subcarriers relative to the carrier, real and
    imaginary part.
    """
    content = arrays()
    labels = read(tmp_path, content).labels
    delays = np.broadcast_to(content["tau"][:, None, :, None], content["a"].shape[:5])
    swapped = {
        "tx": content["rx"],
        "rx": content["tx"],
        "a": content["a"].transpose(2, 3, 0, 1, 4, 5),
    }
    for changes in (
        swapped | {"tau": content["tau"].transpose(1, 0, 2)},
        {"tau": delays},
        {"frequencies": content["frequencies"] - CARRIER},
        {"a": np.stack((content["a"].real, content["a"].imag))},
    ):
        np.testing.assert_allclose(
            read(tmp_path, content | changes).labels, labels, rtol=1e-4, atol=1e-5
        )


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            lambda c: {"a": c["a"][..., 0]},
            r"a: expected complex numbers of .*normalize_delays=False",
        ),
        (lambda c: {"tau": c["tau"] * 1e9}, "tau: expected a delay of 0 to 1 ms in seconds"),
        (
            lambda c: {"tau": c["tau"] - c["tau"][..., :2].min(-1, keepdims=True)},
            "got 0 for the first path of every",
        ),
        (lambda c: {"tau": c["tau"][:1]}, r"tau \(2, 3, 4, 1, 3\) or without antennas, got"),
        (
            lambda c: {"a": np.repeat(c["a"], 2, 3)},
            "expected one antenna at each place of the moving end, got 2",
        ),
        (lambda c: {"carrier": 3.5}, r"carrier must be a carrier in Hz.*in GHz\?"),
        (lambda c: {"carrier": np.zeros(2)}, "carrier: expected one number"),
        (lambda c: {"tx": c["tx"].astype(str)}, "tx: expected real numbers"),
    ],
)
def test_defects_are_named(tmp_path, change, message):
    content = arrays()
    with pytest.raises(ValueError, match=message):
        read(tmp_path, content | change(content))


@pytest.mark.parametrize(("antennas", "per_antenna"), [(1, False), (3, False), (3, True)])
def test_gains_without_the_carriers_phase_get_it(tmp_path, antennas, per_antenna):
    """Free space and a reflection; walls block the direct paths of a third of the links."""
    content = arrays(moving=20, antennas=antennas)
    elements = 0.04 * np.outer(np.arange(antennas) - antennas // 2, (0, 1, 0))
    stands = content["rx"][:, None] + elements * per_antenna
    tau = np.linalg.norm(stands[:, :, None] - content["tx"], axis=-1)[
        ..., None
    ] / speed_of_light + [0, 2e-8, 0]
    a = np.broadcast_to(np.array([1.0, -0.4, 0.0]), tau.shape).astype(complex)
    a[:, :, ::3, 0] = 0
    if not per_antenna:
        tau = tau[:, 0]
    full = tau if per_antenna else tau[:, None]
    content |= {"elements": elements, "tau": tau[:, :, :, None] if per_antenna else tau}
    expected = read(
        tmp_path,
        content | {"a": (a * np.exp(-2j * np.pi * CARRIER * full))[:, :, :, None, :, None]},
    )
    links = read(tmp_path, content | {"a": a[:, :, :, None, :, None]})
    np.testing.assert_allclose(links.labels, expected.labels, atol=1e-3)
    assert "phases of a lack the carrier's over the delay, and get it" in links.remarks
    assert "carrier" not in expected.remarks


def test_amplitude_and_phase_of_paths_are_refused(tmp_path):
    content = arrays(moving=40)
    parts = np.stack((np.abs(content["a"]), np.angle(content["a"])))
    with pytest.raises(
        ValueError, match=r"a: real parts are 0 or more .*\ngive a \* np.exp\(1j \* p\)"
    ):
        read(tmp_path, content | {"a": parts})


def test_delays_from_the_first_path_on_are_read_where_delays_are_unknown(tmp_path):
    content = arrays()
    content["tau"] -= content["tau"][..., :2].min(-1, keepdims=True)
    assert read(tmp_path, content, phase="per_link_and_delay").task.phase == "per_link_and_delay"
