"""Probes of the robot's computer and network, one file each; the contract is ``core.probe``."""
