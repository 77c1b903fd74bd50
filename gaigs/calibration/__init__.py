"""Intervals of predictions, calibrated at links that the predicting model has not seen."""

from gaigs.calibration.conformal import Calibration, Estimate, fewest

__all__ = ["Calibration", "Estimate", "fewest"]
