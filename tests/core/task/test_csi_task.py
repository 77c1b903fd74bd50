"""Complex channels: SNR against the plain formula in numpy, and the phase that is removed against a
search for it.
"""

import numpy as np
import pytest
import torch

from gaigs.core.task.csi import HIGHEST, Csi
from gaigs.testing import check_task

FREQUENCIES = 2.4e9 + 312.5e3 * torch.arange(6, dtype=torch.float64)
TASK = Csi(3, FREQUENCIES)
SCORES = ["snr_db", "snr_aligned_db", "sinad_db", "error_power", "label_power"]


def snr(labels, values):
    """-10 log10(|h - h'|² / |h|²) of each link, in complex128."""
    h, guess = (
        part.numpy().astype(np.complex128).reshape(len(part), -1) for part in (labels, values)
    )
    return -10 * np.log10((abs(h - guess) ** 2).sum(1) / (abs(h) ** 2).sum(1))


@pytest.fixture
def pairs():
    generator = torch.Generator().manual_seed(0)
    labels, noise = torch.randn(2, 7, *TASK.shape, dtype=torch.complex64, generator=generator)
    return labels, labels + torch.logspace(-2, 1, 7)[:, None, None] * noise


@pytest.mark.parametrize("dtype", [torch.complex64, torch.complex128])
def test_scores_equal_their_formulas(pairs, dtype):
    labels, values = (part.to(dtype) for part in pairs)
    scores = TASK.scores(labels, values)
    assert [*scores] == SCORES
    assert scores["snr_db"].dtype == torch.float64
    np.testing.assert_allclose(scores["snr_db"], snr(labels, values), rtol=1e-12)
    power, error = (
        (abs(part.numpy().astype(np.complex128)) ** 2).sum((1, 2))
        for part in (labels, labels - values)
    )
    np.testing.assert_allclose(scores["label_power"], power, rtol=1e-6)
    np.testing.assert_allclose(scores["error_power"], error, rtol=1e-6)
    np.testing.assert_allclose(
        scores["sinad_db"], 10 * np.log10((power + error) / error), rtol=1e-6
    )


def test_the_phase_removed_is_the_best_there_is(pairs):
    """Found here by trying 20,000 of them."""
    labels, values = pairs
    turns = torch.polar(
        torch.ones(20_000, dtype=torch.float64), torch.linspace(0, 2 * np.pi, 20_000).double()
    )
    found = TASK.scores(labels, values)["snr_aligned_db"]
    for k in range(len(labels)):
        turned = turns[:, None, None] * values[k].to(torch.complex128)
        best = snr(labels[k].expand_as(turned), turned).max()
        assert found[k].item() == pytest.approx(best, abs=1e-3)
        assert found[k].item() >= best - 1e-12


def test_the_unit_of_amplitudes_does_not_matter(pairs):
    here = TASK.scores(*pairs)
    for scale in (1e-18, 1e15):
        there = TASK.scores(*(scale * part for part in pairs))
        for name in SCORES[:3]:
            torch.testing.assert_close(there[name], here[name], rtol=1e-5, atol=1e-4)
        assert TASK.summarise(there)["nmse_db"] == pytest.approx(
            TASK.summarise(here)["nmse_db"], abs=1e-4
        )


def test_a_perfect_channel_has_the_highest_snr(pairs):
    scores = TASK.scores(pairs[0], pairs[0])
    for name in SCORES[:3]:
        np.testing.assert_allclose(scores[name], HIGHEST)
    assert TASK.summarise(scores)["nmse_db"] == pytest.approx(-HIGHEST)


def test_silence_predicts_nothing_of_a_channel(pairs):
    scores = TASK.scores(pairs[0], torch.zeros_like(pairs[0]))
    for name, expected in zip(SCORES[:3], (0, 0, 10 * np.log10(2)), strict=True):
        np.testing.assert_allclose(scores[name], expected, atol=1e-12)
    assert TASK.summarise(scores)["nmse_db"] == pytest.approx(0)


def test_a_link_in_deep_shadow_decides_neither_sinad_nor_nmse(pairs):
    """An SNR of -120 dB, of one link in seven."""
    labels, values = pairs
    shadowed = labels.clone()
    shadowed[6] *= 1e-6
    here, there = (TASK.summarise(TASK.scores(part, values)) for part in (labels, shadowed))
    assert there["snr_db_mean"] < here["snr_db_mean"] - 10
    assert abs(there["sinad_db_mean"] - here["sinad_db_mean"]) < 1
    assert abs(there["nmse_db"] - here["nmse_db"]) < 1


def test_the_log_has_the_nmse_of_all_links(pairs):
    scores = TASK.scores(*pairs)
    logged = TASK.logged({name: score.mean().item() for name, score in scores.items()})
    assert [*logged] == [*SCORES[:3], "nmse_db"]
    assert logged["nmse_db"] == pytest.approx(TASK.summarise(scores)["nmse_db"])
    assert logged["sinad_db"] == pytest.approx(scores["sinad_db"].mean().item())


def test_the_summary_is_that_of_numpy(pairs):
    scores = TASK.scores(*pairs)
    expected = {}
    for name in ("snr_db", "snr_aligned_db"):
        score = scores[name].numpy()
        p10, p90 = np.percentile(score, [10, 90])
        numbers = {"median": np.median(score), "mean": score.mean(), "p10": p10, "p90": p90}
        expected |= {f"{name}_{what}": number for what, number in numbers.items()}
    labels, values = (part.numpy().astype(np.complex128) for part in pairs)
    error, power = (abs(labels - values) ** 2).sum(), (abs(labels) ** 2).sum()
    expected |= {
        "sinad_db_mean": scores["sinad_db"].mean().item(),
        "nmse_db": 10 * np.log10(error / power),
    }
    summary = TASK.summarise(scores)
    assert [*summary] == [*expected] == [*Csi.metrics()]
    assert summary == pytest.approx(expected, rel=1e-6)


@pytest.mark.parametrize(
    ("labels", "values", "message"),
    [
        (torch.ones(2, 6, 3), torch.ones(2, 6, 3), r"must both be \('k', 3, 6\), got \(2, 6, 3\)"),
        (torch.ones(2, 3, 6), torch.ones(1, 3, 6), r"got \(2, 3, 6\) and \(1, 3, 6\)"),
        (
            torch.ones(2, 3, 6),
            torch.full((2, 3, 6), torch.nan),
            "predictions must be finite, .* 2 of 2 channels",
        ),
        (torch.full((1, 3, 6), torch.inf), torch.ones(1, 3, 6), "labels must be finite"),
        (
            torch.zeros(2, 3, 6),
            torch.ones(2, 3, 6),
            "not be zero throughout, got 2 such channels; leave them out",
        ),
    ],
)
def test_unusable_channels_are_refused(labels, values, message):
    with pytest.raises(ValueError, match=message):
        TASK.scores(labels.to(torch.complex64), values.to(torch.complex64))


def test_nothing_to_summarise_is_refused():
    nothing = torch.zeros(0, 3, 6, dtype=torch.complex64)
    with pytest.raises(ValueError, match="at least one sample"):
        TASK.summarise(TASK.scores(nothing, nothing))


@pytest.mark.parametrize(
    ("elements", "frequencies", "message"),
    [
        (0, [1e9], "at least one element, got 0"),
        (1, [], r"positive, finite frequencies \[Hz\], got \[\]"),
        (1, [1e9, 0.0], "positive, finite frequencies"),
        (1, [1e9, -1e9], "positive, finite frequencies"),
        (1, [float("nan")], "positive, finite frequencies"),
        (1, [float("inf")], "positive, finite frequencies"),
        (1, [1e9, 1e9], "different frequencies"),
    ],
)
def test_impossible_options_are_refused(elements, frequencies, message):
    with pytest.raises(ValueError, match=message):
        Csi(elements, torch.tensor(frequencies))


def test_frequencies_are_kept_to_the_hertz():
    """In float32 they would be off by up to 128 Hz each."""
    task = Csi(1, torch.tensor([2_437_000_001.0, 2_437_000_002.0], dtype=torch.float64))
    assert task.frequencies.tolist() == [2_437_000_001, 2_437_000_002]
    assert task.shape == (1, 2)
    assert task.directions is None


OTHERS = [Csi(3, FREQUENCIES, phase) for phase in ("per_link", "per_link_and_delay")]
others = pytest.mark.parametrize("task", OTHERS, ids=lambda task: task.phase)


@others
def test_the_contract_holds(task):
    check_task(task)


def as_measured(task, channels, seed=1):
    """Channels with a random phase a link, and with a delay and a gain where the task says so."""
    random = np.random.default_rng(seed)
    phases, delays, gains = random.uniform(-1, 1, (3, len(channels), 1, 1))
    turned = channels.numpy() * np.exp(1j * np.pi * phases)
    if task.phase == "per_link_and_delay":
        offsets = FREQUENCIES.numpy() - FREQUENCIES.numpy().mean()
        turned = turned * np.exp(2j * np.pi * offsets * 1e-6 * delays) * 10**gains
    return torch.from_numpy(turned)


def best_likeness(task, h, guess):
    """|<h', h>| / (|h| |h'|) of one link at the best of many phases and delays."""
    offsets = FREQUENCIES.numpy() - FREQUENCIES.numpy().mean()
    delays = (
        np.linspace(-1.6e-6, 1.6e-6, 40_001) if task.phase == "per_link_and_delay" else np.zeros(1)
    )
    cross = (h.conj() * guess).sum(0) @ np.exp(2j * np.pi * np.outer(offsets, delays))
    return abs(cross).max() / np.linalg.norm(h) / np.linalg.norm(guess)


@others
def test_labels_are_aligned_as_well_as_a_search_can(task, pairs):
    labels, values = (part.to(torch.complex128) for part in pairs)
    turned = task.align(labels, values)
    scores = task.scores(labels, values)
    assert "snr_db" not in scores
    for k, (h, guess, found) in enumerate(
        zip(*(part.numpy() for part in (labels, values, turned)), strict=True)
    ):
        best = best_likeness(task, h, guess)
        sizes = np.linalg.norm(found), np.linalg.norm(guess)
        likeness = np.vdot(found, guess) / sizes[0] / sizes[1]
        assert likeness.real == pytest.approx(best, abs=1e-6)
        assert likeness.imag == pytest.approx(0, abs=1e-9)
        if task.phase == "per_link_and_delay":
            assert sizes[0] == pytest.approx(sizes[1])
            expected = -10 * np.log10(1 - best**2)
        else:
            turned = torch.from_numpy(guess * np.exp(-1j * np.angle(np.vdot(h, guess))))
            expected = snr(labels[k : k + 1], turned[None]).item()
        assert scores["snr_aligned_db"][k].item() == pytest.approx(expected, abs=2e-3)


@others
def test_what_is_unknown_of_a_link_changes_no_score(task, pairs):
    labels, values = (part.to(torch.complex128) for part in pairs)
    here, there = task.scores(labels, values), task.scores(as_measured(task, labels), values)
    for name in ("snr_aligned_db", "sinad_db"):
        torch.testing.assert_close(there[name], here[name], rtol=1e-6, atol=1e-6)
    numbers = task.summarise(here)
    assert next(iter(numbers)) == "snr_aligned_db_median"
    assert not any(name.startswith("snr_db") for name in numbers)
    torch.testing.assert_close(
        task.scores(as_measured(task, values), values)["snr_aligned_db"],
        torch.full((7,), HIGHEST).double(),
    )


def test_subcarriers_in_any_order_and_unevenly_spaced_have_one_delay():
    frequencies = torch.tensor([5.18e9, 5.2e9, 5.1801e9, 5.19e9, 5.1903e9, 5.185e9, 5.1951e9])
    task = Csi(1, frequencies, "per_link_and_delay")
    channel = torch.randn(
        4, 1, 7, dtype=torch.complex128, generator=torch.Generator().manual_seed(0)
    )
    delays = torch.tensor([-40e-9, -3e-9, 0, 33e-9], dtype=torch.float64)
    turns = torch.exp(2j * torch.pi * (task.frequencies - 5.2e9) * delays[:, None])[:, None]
    torch.testing.assert_close(task.align(turns * channel, channel), channel, rtol=1e-6, atol=1e-6)


def test_a_misspelt_phase_is_refused():
    with pytest.raises(
        ValueError,
        match=r"data\.phase must be known or per_link or per_link_and_delay, got 'perlink'",
    ):
        Csi(1, FREQUENCIES, "perlink")
