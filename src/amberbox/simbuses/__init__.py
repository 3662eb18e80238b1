"""The real buses of the simulated robot: one file each, loaded by ``python -m amberbox.sim``."""
