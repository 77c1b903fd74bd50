"""Models predict labels of a task from transmitter, receiver, carrier and directions."""

from gaigs.model.base import Model, Prediction
from gaigs.model.look_up import LookUp
from gaigs.model.wrapper import Wrapper, build_trend

__all__ = ["LookUp", "Model", "Prediction", "Wrapper", "build_trend"]
