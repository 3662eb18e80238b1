"""Detectors, one file each; the contract is ``Detector`` in ``amberbox.core.contracts``."""
