"""Options of losses, tokenizers and deformations that are refused, and labels that a loss does not
compare.
"""

import pytest

from gaigs.registry import registry
from gaigs.testing import example_links


@pytest.mark.parametrize(
    ("kind", "name", "options", "task", "message"),
    [
        ("loss", "huber", {"delta": 0.0}, "rssi", r"loss\.delta must be more than 0, got 0.0"),
        (
            "loss",
            "l1_ssim",
            {"ssim": -0.1},
            "spectrum",
            r"loss\.ssim must be in \[0, 1\], got -0.1",
        ),
        ("loss", "l1_ssim", {"ssim": 1.1}, "spectrum", r"loss\.ssim must be in \[0, 1\], got 1.1"),
        *(
            (
                "loss",
                "log_relative_error",
                {"floor": floor},
                "csi",
                r"loss\.floor must be more than 0 and less than 1",
            )
            for floor in (0.0, -1.0, 1.0)
        ),
        *(
            (
                "loss",
                name,
                {},
                "csi",
                "labels of task 'csi' are complex, .*; set loss=log_relative_error",
            )
            for name in ("absolute", "squared", "huber")
        ),
        ("loss", "l1_ssim", {}, "rssi", "'l1_ssim' compares spectra, not labels of task 'rssi'"),
        (
            "loss",
            "relative_error",
            {},
            "rssi",
            "'rssi' are real, not complex channels; set loss=squared",
        ),
        ("loss", "log_relative_error", {}, "spectrum", "'spectrum' are real, not complex"),
        (
            "tokenizer",
            "euclidean",
            {"transmitter_octaves": (3, 2)},
            "rssi",
            r"within -30..30, got \[3, 2\]",
        ),
        (
            "tokenizer",
            "euclidean",
            {"gaussian_octaves": (-31, 2)},
            "rssi",
            r"within -30..30, got \[-31, 2\]",
        ),
        ("tokenizer", "euclidean", {"hidden": 0}, "rssi", "hidden and width .* got 0, 64"),
        ("tokenizer", "euclidean", {"width": 0}, "rssi", "hidden and width .* got 256, 0"),
        ("tokenizer", "euclidean", {"hidden": None}, "rssi", "hidden and width .* got None, 64"),
        ("tokenizer", "euclidean", {"width": None}, "rssi", "hidden and width must both be given"),
        (
            "tokenizer",
            "ga",
            {"algebra": "conformal"},
            "rssi",
            "projective, spacetime, got 'conformal'",
        ),
        *(
            ("tokenizer", "ga", {option: 0}, "rssi", f"{option} must be at least 1, got 0")
            for option in ("anchors", "blocks", "multivectors", "scalars", "heads", "width")
        ),
        ("tokenizer", "ga", {"scalars": 2}, "rssi", "must be multiples of 4 heads"),
        ("tokenizer", "ga", {"multivectors": 3, "heads": 1}, "rssi", "must be even, got 3"),
        (
            "tokenizer",
            "multiview",
            {"ga": {"name": "ga", "depth": 1}},
            "rssi",
            "tokenizer 'ga' has no option 'depth'",
        ),
        ("tokenizer", "multiview", {"euclidean": "euclid"}, "rssi", "unknown tokenizer 'euclid'"),
        (
            "deformation",
            "two_branch",
            {"heads": ["signal", "shift", "phase"]},
            "rssi",
            "opacity, .* got phase, shift",
        ),
        (
            "deformation",
            "two_branch",
            {"width": 0},
            "rssi",
            r"deformation\.width must be at least 1, got 0",
        ),
        (
            "deformation",
            "two_branch",
            {"attenuation_layers": -1},
            "rssi",
            r"attenuation_layers must be at least 0, got -1",
        ),
        (
            "deformation",
            "two_branch",
            {"signal_layers": -2},
            "rssi",
            r"signal_layers must be at least 0, got -2",
        ),
    ],
)
def test_impossible_options_are_refused(kind, name, options, task, message):
    links = example_links(task)
    context = {
        "loss": {"task": links.task},
        "deformation": {"channels": 2, "tokenizer_widths": (5, 4, 6), "count": 7},
    }
    with pytest.raises(ValueError, match=message):
        registry(kind).build({"name": name, **options}, scene=links.scene, **context.get(kind, {}))
