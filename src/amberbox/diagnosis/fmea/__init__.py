"""Failure mode and effects analysis: the file, its entries, what is computed from it."""

from amberbox.diagnosis.fmea.loader import load_fmea as load_fmea
