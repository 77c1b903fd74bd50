"""The version of gaigs: a run folder is of one series, such as 0.2."""

__version__ = "0.4.0"
