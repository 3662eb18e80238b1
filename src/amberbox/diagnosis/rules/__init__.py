"""An expert system: rules in a stated subset of ISO Prolog, with the reasons for every answer."""

from amberbox.diagnosis.rules.answers import Answers
from amberbox.diagnosis.rules.ask import ask
from amberbox.diagnosis.rules.budget import Budget
from amberbox.diagnosis.rules.export import export
from amberbox.diagnosis.rules.program import Program, read_rules, read_text
from amberbox.diagnosis.rules.virtual import Virtual

__all__ = [
    "Answers",
    "Budget",
    "Program",
    "Virtual",
    "ask",
    "export",
    "read_rules",
    "read_text",
]
