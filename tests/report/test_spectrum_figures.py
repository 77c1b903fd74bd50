"""Spectra beside their predictions, read back from their artists."""

import numpy as np
import pytest

from gaigs.report.predictions import Examples
from gaigs.report.spectrum import spectra

ELEVATIONS, AZIMUTHS = np.arange(10.0, 91, 10), np.arange(0.0, 360, 15)


@pytest.fixture
def rng():
    return np.random.default_rng(5)


def meshes(figure):
    """The coloured panels, row by row."""
    return [ax.collections[0] for ax in figure.axes if ax.get_label() != "<colorbar>"]


def corners_of_pixel(mesh, row, column):
    return mesh.get_coordinates()[row : row + 2, column : column + 2].reshape(4, 2)


@pytest.mark.parametrize("polar", [False, True])
def test_spectra_show_label_prediction_and_error(rng, polar):
    labels, predictions = rng.random((2, 2, 9, 24)).astype(np.float16)
    shown = Examples(labels, predictions, np.array([0.25, 0.875]), ["worst", "best"])
    figure = spectra(shown, ELEVATIONS, AZIMUTHS, polar)
    figure.draw_without_rendering()
    panels = [mesh.get_array().reshape(9, 24) for mesh in meshes(figure)]
    for row in range(2):
        label, prediction, error = panels[3 * row : 3 * row + 3]
        np.testing.assert_array_equal(label, labels[row])
        np.testing.assert_array_equal(prediction, predictions[row])
        np.testing.assert_allclose(error, predictions[row].astype(float) - labels[row], atol=1e-7)
    titles = [ax.get_title() for ax in figure.axes[:6]]
    assert titles[:2] == ["Label, worst", "Prediction, SSIM 0.250"]
    assert titles[3:5] == ["Label, best", "Prediction, SSIM 0.875"]
    assert titles[2] == f"Error, MAE {np.abs(panels[2]).mean():.3f}"


def test_colours_of_errors_are_the_same_both_ways_and_in_all_rows():
    labels, predictions = np.full((2, 9, 24), 0.5), np.full((2, 9, 24), 0.6)
    predictions[1, 4, 4] = 0.1
    figure = spectra(Examples(labels, predictions, np.zeros(2), ["a", "b"]), ELEVATIONS, AZIMUTHS)
    assert [mesh.get_clim() for mesh in meshes(figure)[2::3]] == [pytest.approx((-0.4, 0.4))] * 2
    perfect = spectra(Examples(labels, labels, np.ones(2), ["a", "b"]), ELEVATIONS, AZIMUTHS)
    perfect.draw_without_rendering()
    assert meshes(perfect)[2].norm(0.0) == 0.5


def test_pixels_lie_where_their_directions_are():
    shown = Examples(*np.zeros((2, 1, 9, 24)), np.ones(1), ["a"])
    plane, sky = (meshes(spectra(shown, ELEVATIONS, AZIMUTHS, polar))[0] for polar in (False, True))
    np.testing.assert_allclose(corners_of_pixel(plane, 2, 6).mean(0), (90, 30))
    np.testing.assert_allclose(corners_of_pixel(sky, 2, 6).mean(0), (np.pi / 2, 60))
    radii = corners_of_pixel(sky, 8, 0)[:, 1]
    assert radii.min() == 0  # the zenith's pixels end in the middle instead of running through it
    assert radii.max() == 5
