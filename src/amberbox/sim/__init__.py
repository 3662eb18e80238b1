"""A simulated hospital transport robot whose physics carry faults to what sensors see."""

from amberbox.sim.faults import SimulatedFault, catalogue, load_faults
from amberbox.sim.robot import Robot
from amberbox.sim.topics import TOPICS, TopicSpec

__all__ = ["TOPICS", "Robot", "SimulatedFault", "TopicSpec", "catalogue", "load_faults"]
