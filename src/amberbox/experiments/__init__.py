"""Experiments on robots: the actions that a robot can do."""
