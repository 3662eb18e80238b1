"""Failure mode and effects analysis: the file, its entries, and values computed from it."""

from amberbox.diagnosis.fmea.loader import load_fmea as load_fmea
