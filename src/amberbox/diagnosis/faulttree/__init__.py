"""Fault tree analysis: minimal cut sets, exact probability, importance, Open-PSA files."""

from amberbox.diagnosis.faulttree.analysis import analyse as analyse
from amberbox.diagnosis.faulttree.analysis import closest as closest
from amberbox.diagnosis.faulttree.open_psa import read_mef as read_mef
from amberbox.diagnosis.faulttree.open_psa import write_mef as write_mef
from amberbox.diagnosis.faulttree.tree import fault_tree as fault_tree
