"""Localisation: places of transmitters from the labels of all receivers.

A fingerprint holds the labels of one transmission at all receivers.
"""

from gaigs.commands.locate.command import run

__all__ = ["run"]
