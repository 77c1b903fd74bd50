"""Checks of each kind's contract, for the tests of components.

>>> from gaigs.registry import registry
>>> check_projection(registry("projection").build({"name": "mercator"}, pixel=0.02))

A check raises an ``AssertionError`` with the broken rule, or returns nothing.
"""

from gaigs.testing.data import check_data as check_data
from gaigs.testing.data import example_links as example_links
from gaigs.testing.deformation import check_deformation as check_deformation
from gaigs.testing.loss import check_loss as check_loss
from gaigs.testing.model import check_model as check_model
from gaigs.testing.placement import check_placement as check_placement
from gaigs.testing.pooling import check_pooling as check_pooling
from gaigs.testing.projection import check_projection as check_projection
from gaigs.testing.rasterizer import check_rasterizer as check_rasterizer
from gaigs.testing.split import check_split as check_split
from gaigs.testing.task import check_task as check_task
from gaigs.testing.tokenizer import check_tokenizer as check_tokenizer
from gaigs.testing.training import check_training as check_training
