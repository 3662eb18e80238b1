"""Probes, one file each; the contract is ``core.probe``."""
