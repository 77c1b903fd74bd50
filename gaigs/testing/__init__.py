"""Checks of each kind's contract, for the tests of components.

>>> from gaigs.registry import registry
>>> check_projection(registry("projection").build({"name": "mercator"}, pixel=0.02))

A check raises an ``AssertionError`` with the broken rule, or returns nothing.
"""

from gaigs.testing.data import check_data, example_links
from gaigs.testing.deformation import check_deformation
from gaigs.testing.loss import check_loss
from gaigs.testing.model import check_model
from gaigs.testing.placement import check_placement
from gaigs.testing.pooling import check_pooling
from gaigs.testing.projection import check_projection
from gaigs.testing.rasterizer import check_rasterizer
from gaigs.testing.split import check_split
from gaigs.testing.task import check_task
from gaigs.testing.tokenizer import check_tokenizer
from gaigs.testing.training import check_training

__all__ = [
    "check_data",
    "check_deformation",
    "check_loss",
    "check_model",
    "check_placement",
    "check_pooling",
    "check_projection",
    "check_rasterizer",
    "check_split",
    "check_task",
    "check_tokenizer",
    "check_training",
    "example_links",
]
