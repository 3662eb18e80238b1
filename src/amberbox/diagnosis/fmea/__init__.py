"""The robot's failure modes, written once: what fails, what it costs, how it shows."""

from amberbox.diagnosis.fmea.known import Known
from amberbox.diagnosis.fmea.load import load_fmea
from amberbox.diagnosis.fmea.model import Fmea

__all__ = ["Fmea", "Known", "load_fmea"]
