"""Simulated robots, and a real server that they load; see ``benchmarks/fleet_load.py``."""
