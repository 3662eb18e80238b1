"""The names that rules may use although no file defines them: without facts they fail."""

from __future__ import annotations

from collections.abc import Mapping

from amberbox.diagnosis.rules.terms import Key

VOCABULARY: Mapping[Key, str] = {
    ("robot", 1): "a robot",
    ("component", 1): "a component of the FMEA or of the monitors",
    ("type", 2): "component, its type",
    ("part_of", 2): "component, the larger component or robot it belongs to",
    ("function", 1): "a function of the FMEA",
    ("needs", 2): "function or component, what it needs",
    ("failure_mode", 2): "component, one of its failure modes",
    ("class", 3): "component, failure mode, its class",
    ("cause", 3): "component, failure mode, what causes it",
    ("effect", 3): "component, failure mode, the function it takes away",
    ("severity", 3): "component, failure mode, a number",
    ("probability", 3): "component, failure mode, a number",
    ("remedy", 3): "component, failure mode, what to do",
    ("symptom", 1): "a symptom of the FMEA",
    ("shows", 3): "component, failure mode, a symptom of it",
    ("present", 1): "a symptom that is there now",
    ("absent", 1): "a symptom that is known not to be there",
    ("unknown", 1): "a symptom of which nothing is known",
    ("status", 4): "component, status, from, to: what monitors said",
    ("mission", 4): "mission, outcome, from, to",
    ("holds", 3): "condition, from, to: when it was the case",
}
"""What the FMEA, the monitors and the record say, with the meaning of the arguments."""
