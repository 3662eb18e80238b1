"""Help for people who write plugins: a contract kit, a sink in memory, a clock moved by hand."""

from amberbox.testing.clock import ManualClock
from amberbox.testing.contract import MemorySink

__all__ = ["ManualClock", "MemorySink"]
