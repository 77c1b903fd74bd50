"""Localisation: where a transmitter is, by what the receivers receive of its transmissions.

A fingerprint holds what all receivers received of one transmission.
"""

from gaigs.commands.locate.command import run

__all__ = ["run"]
