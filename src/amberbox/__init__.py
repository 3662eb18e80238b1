"""Amberbox: a flight recorder and a doctor for robots."""

__version__ = "0.1.0"
