"""Checks of the contracts of plug-ins, for their tests.

A check raises an ``AssertionError`` that names the broken rule, or returns nothing.

Example:
    >>> from gaigs.testing import check_task, example_links
    >>> check_task(example_links("rssi").task)
"""

from gaigs.testing.data import check_data as check_data
from gaigs.testing.data import example_links as example_links
from gaigs.testing.model import check_model as check_model
from gaigs.testing.placement import check_placement as check_placement
from gaigs.testing.pooling import check_pooling as check_pooling
from gaigs.testing.task import check_task as check_task
