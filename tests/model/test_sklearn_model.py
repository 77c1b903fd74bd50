"""Regressors of scikit-learn as models."""

import numpy as np
import pytest
import torch

import gaigs
from gaigs.registry import registry
from gaigs.testing import check_model, example_links

pytest.importorskip("sklearn")

from sklearn.ensemble import RandomForestRegressor
from sklearn.gaussian_process import GaussianProcessRegressor
from sklearn.gaussian_process.kernels import RBF, WhiteKernel
from sklearn.neighbors import KNeighborsRegressor
from sklearn.pipeline import make_pipeline
from sklearn.preprocessing import StandardScaler
from sklearn.svm import SVR


@pytest.fixture(scope="module")
def links():
    return gaigs.links("synthetic_rssi", transmitters=60)


@pytest.mark.parametrize("task", ["rssi", "spectrum", "csi"])
def test_it_keeps_the_contract_of_a_model(task):
    def build(scene):
        options = {"name": "sklearn", "estimator": "sklearn.neighbors.KNeighborsRegressor"}
        return registry("model").build(options, scene=scene)

    check_model(build, example_links(task))


def test_it_predicts_what_the_regressor_does(links):
    model = gaigs.train("sklearn", links, estimator=KNeighborsRegressor(3))
    known = links.known(1)
    places, levels = links.query.transmitters[known].numpy(), links.labels[known].numpy()
    asked = np.array([[1.0, 2.0, 1.5], [2.5, 1.0, 0.8]])
    expected = KNeighborsRegressor(3).fit(places, levels).predict(asked)
    np.testing.assert_allclose(model.predict(asked, receiver=1), expected, rtol=1e-6)


@pytest.mark.parametrize(
    "estimator",
    [
        RandomForestRegressor(n_estimators=5),
        make_pipeline(StandardScaler(), SVR(C=10.0)),
        {"_target_": "sklearn.ensemble.RandomForestRegressor", "n_estimators": 5},
        {
            "_target_": "sklearn.ensemble.BaggingRegressor",
            "n_estimators": 2,
            "estimator": "sklearn.svm.SVR",
        },
    ],
    ids=["forest", "pipeline", "mapping", "nested"],
)
def test_a_checkpoint_predicts_the_same(links, estimator, tmp_path):
    model = gaigs.train("sklearn", links, estimator=estimator)
    model.save(tmp_path / "room.ckpt")
    asked = links.query.transmitters[:5]
    again = gaigs.load(tmp_path / "room.ckpt")
    assert torch.equal(again.predict(asked), model.predict(asked))


def test_a_regressor_that_knows_its_deviation_gives_the_widths_of_intervals(links):
    process = GaussianProcessRegressor(RBF() + WhiteKernel(), normalize_y=True)
    model = gaigs.train("sklearn", links, estimator=process)
    near, far = model.predict([[3.0, 2.0, 1.0], [6.0, 5.0, 3.0]], receiver=0, interval=0.9).std
    assert far > 1.2 * near


def test_it_is_a_row_like_any_other():
    words = ["model=sklearn", "model.estimator=sklearn.svm.SVR", "data=synthetic_rssi", "task=rssi"]
    assert gaigs.compose(*words)["model"] == {"name": "sklearn", "estimator": "sklearn.svm.SVR"}
    mapping = "model.estimator={_target_: sklearn.svm.SVR, C: 10}"
    found = gaigs.compose("model=sklearn", mapping, *words[2:])["model"]["estimator"]
    assert found == {"_target_": "sklearn.svm.SVR", "C": 10}


@pytest.mark.parametrize(
    ("estimator", "message"),
    [
        (None, "needs a regressor: set model.estimator=sklearn"),
        ("sklearn.svm.SRV", r"such as sklearn.svm.SVR, got .*; sklearn.svm has no 'SRV' \(did you"),
        ("sklearn.nothing.SVR", "there is no module sklearn.nothing"),
        ("SVR", "a regressor of scikit-learn with its module, .* got 'SVR'"),
        ("sklearn.svm.SVC", "must be a regressor of scikit-learn"),
        ({"_target_": "os.system"}, "must be a class of scikit-learn, .* got 'os.system'"),
        ({"_target_": "sklearn.svm.SVR", "gama": 1}, r"no option 'gama' \(did you mean 'gamma'"),
    ],
)
def test_mistakes_end_in_two_lines_that_help(links, estimator, message):
    with pytest.raises(ValueError, match=message) as caught:
        gaigs.train("sklearn", links, estimator=estimator)
    assert str(caught.value).count("\n") <= 1


def test_a_regressor_of_one_output_is_refused_for_spectra():
    with pytest.raises(ValueError, match=r"cannot be fitted to .*sklearn.multioutput.MultiOutput"):
        gaigs.train("sklearn", example_links("spectrum"), estimator=SVR())
