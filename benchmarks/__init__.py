"""Measurements of the numbers that the documentation quotes."""
