"""Missions: intervals of the record that have a name, an outcome and parameters."""

from amberbox.blackbox.missions.mission import Mission, choose, load

__all__ = ["Mission", "choose", "load"]
