"""Scenarios of DeepMIMO v4 as links with channels or signal strengths."""
