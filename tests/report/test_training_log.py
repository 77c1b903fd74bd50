"""The log of a training, as Lightning writes it and a killed run leaves it."""

import pytest

from gaigs.report.training_log import read_curves


@pytest.mark.parametrize(
    ("texts", "steps", "values"),
    [
        (
            ["step,a\n1,0.5\n2,0.25\n3,0.1", "", "step,a\n3,0.125\n"],
            [1, 2, 3],
            [0.5, 0.25, 0.125],
        ),  # a cut row
        (
            ["step,a\n99,60\n149,90\n199,120\n", "step,a\n139,130\n189,160\n"],
            [99, 139, 189],
            [60, 130, 160],
        ),  # lost rows
    ],
)
def test_the_log_of_a_killed_run_goes_on_with_the_next_start(texts, steps, values, tmp_path):
    paths = [tmp_path / f"{number}.csv" for number in range(len(texts))]
    for path, text in zip(paths, texts, strict=True):
        path.write_text(text)
    found = read_curves(paths)["a"]
    assert [axis.tolist() for axis in found] == [steps, values]
