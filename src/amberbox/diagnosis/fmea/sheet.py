"""An FMEA sheet as CSV: one line per failure mode, the usual columns, out and in again."""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence

from amberbox.diagnosis.fmea.criticality import mode_criticality
from amberbox.diagnosis.fmea.model import FailureMode, Fmea
from amberbox.diagnosis.fmea.priorities import Rule, priority

COLUMNS = (
    "Item", "Item description", "Function", "Failure mode", "Description", "Cause",
    "Local effect", "Next effect", "End effect", "Class", "Severity", "S", "O", "D", "RPN",
    "Priority", "Rate (1/h)", "Probability", "Exposure (h)", "Beta", "Cm", "Detection",
    "Undetected because", "Make safe", "Action",
)  # fmt: skip
"""What a sheet has, in this order."""

_FORMULA = ("=", "+", "-", "@", "\t", "\r")


def write_sheet(fmea: Fmea, rules: Sequence[Rule] = ()) -> str:
    """Return the sheet as the text of a CSV file."""
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow(COLUMNS)
    for mode in fmea.modes.values():
        row = row_of(fmea, mode, rules)
        writer.writerow([_safe(row[column]) for column in COLUMNS])
    return out.getvalue()


def row_of(fmea: Fmea, mode: FailureMode, rules: Sequence[Rule] = ()) -> dict[str, str]:
    """Return a line of the sheet by column."""
    ranks, effects = mode.ranks, mode.effects
    functions = [n for n, f in fmea.functions.items() if mode.component in f.needs.names()]
    return {
        "Item": mode.component,
        "Item description": fmea.components[mode.component].description,
        "Function": _listed(functions),
        "Failure mode": mode.name,
        "Description": mode.description,
        "Cause": mode.cause,
        "Local effect": effects.local,
        "Next effect": _listed(effects.next),
        "End effect": _listed(effects.system),
        "Class": _listed(mode.classes),
        "Severity": mode.severity,
        "S": _number(ranks.severity),
        "O": _number(ranks.occurrence),
        "D": _number(ranks.detection),
        "RPN": _number(ranks.number),
        "Priority": priority(ranks, rules),
        "Rate (1/h)": _number(mode.rate),
        "Probability": _number(mode.probability),
        "Exposure (h)": _number(mode.exposure_h),
        "Beta": _number(mode.beta),
        "Cm": _number(mode_criticality(mode)),
        "Detection": _listed([link.symptom for link in mode.symptoms]),
        "Undetected because": mode.unobservable,
        "Make safe": mode.make_safe,
        "Action": mode.remedy,
    }


def _listed(names: Sequence[str]) -> str:
    return "; ".join(names)


def _number(value: float | None) -> str:
    return "" if value is None else f"{value:.12g}"


def _safe(cell: str) -> str:
    """Keep spreadsheets from taking a text for a formula."""
    return f"'{cell}" if cell.startswith(_FORMULA) else cell
