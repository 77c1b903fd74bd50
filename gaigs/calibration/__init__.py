"""Intervals of predictions, calibrated at links outside the training."""

from gaigs.calibration.conformal import Calibration, Estimate, fewest

__all__ = ["Calibration", "Estimate", "fewest"]
