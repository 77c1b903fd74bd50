"""Models as regressors of scikit-learn."""

import importlib
import sys

import numpy as np
import pytest

import gaigs

pytest.importorskip("sklearn")

from sklearn.base import clone
from sklearn.exceptions import NotFittedError
from sklearn.metrics import r2_score
from sklearn.model_selection import GridSearchCV, cross_val_score
from sklearn.utils.estimator_checks import check_estimator

from gaigs.sklearn import Regressor

RNG = np.random.default_rng(0)
PLACES = RNG.uniform(0, 20, (60, 2))
STANDS = np.array([[2.0, 3.0, 2.0], [18.0, 15.0, 2.0]])
APART = np.linalg.norm(np.column_stack((PLACES, np.ones(60)))[:, None] - STANDS, axis=2)
LEVELS = -40 - 25 * np.log10(APART) + RNG.normal(0, 1, APART.shape)  # (n, k) [dBm]


def test_it_works_in_cross_validation_and_in_a_grid_search():
    scores = cross_val_score(Regressor("path_loss", STANDS), PLACES, LEVELS, cv=3)
    assert scores.min() > 0.9
    search = GridSearchCV(Regressor("knn", STANDS), {"k": [1, 4]}, cv=2).fit(PLACES, LEVELS[:, 0:2])
    assert search.best_params_ == {"k": 4}


def test_one_receiver_has_a_vector_and_several_a_column_each():
    one = Regressor("path_loss", STANDS[0]).fit(PLACES, LEVELS[:, 0])
    assert one.predict(PLACES[:5]).shape == (5,)
    both = Regressor("path_loss").fit(np.column_stack((PLACES, np.ones(60))), LEVELS)
    levels, deviations = both.predict(np.column_stack((PLACES, np.ones(60)))[:5], return_std=True)
    assert levels.shape == deviations.shape == (5, 2)
    assert (deviations > 0).all()


def test_levels_that_were_not_received_do_not_count():
    heard = LEVELS.copy()
    heard[::3, 0] = np.nan
    silent = np.column_stack((heard, np.full(60, np.nan)))
    regressor = Regressor("path_loss").fit(PLACES, silent)
    levels = regressor.predict(PLACES)
    assert np.isnan(levels).all(0).tolist() == [False, False, True]
    is_heard = ~np.isnan(heard[:, 0])
    expected = [
        r2_score(heard[is_heard, 0], levels[is_heard, 0]),
        r2_score(heard[:, 1], levels[:, 1]),
    ]
    assert regressor.score(PLACES, silent) == pytest.approx(np.mean(expected))
    with pytest.raises(ValueError, match="two levels of a receiver or more, got none"):
        regressor.score(PLACES[:1], silent[:1])


def test_options_of_the_training_are_parameters():
    regressor = Regressor("knn", k=2, height=1.5)
    assert regressor.get_params() == {
        "model": "knn",
        "receivers": None,
        "height": 1.5,
        "seed": 0,
        "k": 2,
    }
    other = clone(regressor).set_params(k=3, seed=1)
    assert (other.get_params()["k"], other.seed, regressor.get_params()["k"]) == (3, 1, 2)
    assert repr(other) == "Regressor(height=1.5, k=3, model='knn', seed=1)"


def test_named_receivers_may_stand_in_any_form():
    named = {"west": STANDS[0], "east": STANDS[1]}
    levels = Regressor("path_loss", named).fit(PLACES, LEVELS).predict(PLACES[:3])
    plain = Regressor("path_loss", STANDS).fit(PLACES, LEVELS).predict(PLACES[:3])
    np.testing.assert_allclose(levels, plain)


@pytest.mark.parametrize(
    ("regressor", "places", "levels", "message"),
    [
        (Regressor(), PLACES[:, :1], LEVELS, r"X must be positions .* got 1 feature\(s\)"),
        (Regressor("friis"), PLACES, LEVELS, "friis"),
        (Regressor("knn", neighbours=3), PLACES, LEVELS, "neighbours"),
        (Regressor("nearest"), PLACES, LEVELS, "nearest"),
        (Regressor(), PLACES, LEVELS + 500, "from -200 to 30 dBm"),
    ],
)
def test_mistakes_end_in_two_lines_that_help(regressor, places, levels, message):
    with pytest.raises(ValueError, match=message) as caught:
        regressor.fit(places, levels)
    assert str(caught.value).count("\n") <= 1


def test_nothing_is_predicted_before_the_fit():
    with pytest.raises(NotFittedError):
        Regressor().predict(PLACES)


@pytest.mark.filterwarnings("ignore")
def test_the_checks_of_scikit_learn_pass_but_for_other_numbers_of_features():
    results = check_estimator(Regressor("mean"), on_fail=None, legacy=False)
    failed = {
        result["check_name"]: str(result["exception"])
        for result in results
        if result["status"] == "failed"
    }
    # Parameters without a name of their own are in ``options``; scikit-learn cannot know it.
    failed.pop("check_no_attributes_set_in_init")
    others = {name: message for name, message in failed.items() if "feature(s)" not in message}
    assert {*others} <= {"check_positive_only_tag_during_fit"}, others


def test_a_missing_package_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "sklearn", None)
    monkeypatch.setitem(sys.modules, "sklearn.base", None)
    monkeypatch.delitem(sys.modules, "gaigs.sklearn", raising=False)
    with pytest.raises(
        ImportError, match=r"scikit-learn is missing: pip install 'gaigs\[sklearn\]'"
    ):
        importlib.import_module("gaigs.sklearn")
    with pytest.raises(ImportError, match=r"pip install 'gaigs\[sklearn\]'"):
        gaigs.train(
            "sklearn", gaigs.links("synthetic_rssi", transmitters=20), estimator="sklearn.svm.SVR"
        )
