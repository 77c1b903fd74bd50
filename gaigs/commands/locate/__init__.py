"""Localisation: where a transmitter is, by the value that receivers measure of it."""

from gaigs.commands.locate.command import run

__all__ = ["run"]
