"""Entry point of the maintenance process: ``python -m amberbox.blackbox.keeper STORE``."""
