"""The rule files of a robot folder, and which names they define."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from amberbox.core.errors import ConfigurationError
from amberbox.diagnosis.fmea.known import Known
from amberbox.diagnosis.rules import read_rules

RULES = "rules"
"""Where they are in a robot folder."""


def rule_files(folder: Path) -> list[Path]:
    """Return the rule files of a robot folder, by name."""
    return sorted((folder / RULES).glob("*.pl"))


def with_rules(known: Known, folder: Path) -> Known:
    """Return what failure modes can refer to, with the names that a folder's rules define.

    Of rules that cannot be read nothing is known: what is wrong with them is told by who reads
    them to ask them, and by ``amberbox check``; a robot is diagnosed without them meanwhile.
    """
    try:
        program = read_rules(rule_files(folder))
    except ConfigurationError:
        return known
    heads = {key: (place.file, place.line) for key, place in program.heads.items()}
    return replace(known, predicates=frozenset(program.known), heads=heads)
