"""Fault trees: minimal cut sets, exact probability, importance, what is closest to happening."""

from __future__ import annotations

from amberbox.diagnosis.faulttree.analysis import Analysis, analyse
from amberbox.diagnosis.faulttree.budget import Budget
from amberbox.diagnosis.faulttree.closest import Closeness, closest
from amberbox.diagnosis.faulttree.mef_reader import read_mef
from amberbox.diagnosis.faulttree.mef_writer import write_mef
from amberbox.diagnosis.faulttree.tree import FaultTree, fault_tree

__all__ = [
    "Analysis",
    "Budget",
    "Closeness",
    "FaultTree",
    "analyse",
    "closest",
    "fault_tree",
    "read_mef",
    "write_mef",
]
