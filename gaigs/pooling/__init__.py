"""Poolings turn the map over directions into what the receiver reports."""
