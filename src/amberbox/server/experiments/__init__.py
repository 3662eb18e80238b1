"""Experiments and unit tests on robots: those that are kept here, their runs, and the runner."""
