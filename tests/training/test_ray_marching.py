import json
import subprocess
import sys
from pathlib import Path

import pytest
import torch
from fitting import fit, make_links
from ray_marching import SAMPLES, WIDTH, make

from gaigs.query import Batch


@pytest.fixture(scope="module")
def links():
    return make_links()


@pytest.mark.parametrize("chunk", [1, 700, 720, 721, 3000, 100_000])
def test_whole_spectra_are_evaluated_by_chunks(links, chunk):
    model = make(links, rays=10).model
    batch = links.batch(torch.arange(12))
    with torch.no_grad():
        whole = model(batch).value
    if chunk == 1:
        batch = Batch(batch.query[:1], batch.directions.thin(slice(0, 4), slice(0, 5)))
        whole = whole[:1, :4, :5]
    model.chunk, model.asked = chunk, set()
    torch.testing.assert_close(model.evaluate(batch), whole)
    assert max(model.asked) <= chunk


def test_a_field_learns_from_random_rays(links, tmp_path):
    module = make(links, rays=40)
    batch = links.batch(links.split.train)
    error = lambda: (module.model.evaluate(batch) - batch.labels).square().mean().item()
    before = error()
    module.model.asked = set()
    fit(module, links, tmp_path, 60, val_check_interval=60)
    assert module.model.asked == {8 * 40, 720}, "8 places a step; spectra of 720 pixels, one at a time"
    # Labels are uniform in [0, 1]: their variance, 1/12, is the least that a smooth field can come to.
    assert error() < 0.2 * before + 0.8 / 12


@pytest.mark.skipif(sys.platform == "win32", reason="Windows does not tell the peak")
def test_whole_spectra_need_little_memory(tmp_path):
    """16 spectra of 90 x 360 pixels at once would need 4 GiB for one layer of the network alone."""
    assert 16 * 90 * 360 * SAMPLES * WIDTH * 4 > 3.9 * 2**30
    program = Path(__file__).with_name("ray_marching.py")
    subprocess.run([sys.executable, program, tmp_path], check=True, capture_output=True)
    told = json.loads((tmp_path / "told.json").read_text())
    assert told["peak_gib"] < 1.5
    assert max(told["asked"]) <= 16 * 512
    assert 0 < told["mae"] < 1
