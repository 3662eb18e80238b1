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
    ("severity", 3): "component, failure mode, warning, urgent, critical or fatal",
    ("probability", 3): "component, failure mode, how probable it is to be there",
    ("risk", 3): "component, failure mode, S x O x D",
    ("remedy", 3): "component, failure mode, what to do",
    ("symptom", 1): "a symptom of the FMEA",
    ("shows", 3): "component, failure mode, a symptom of it",
    ("test", 2): "a test of the FMEA, what it asks",
    ("outcome", 4): "component, failure mode, a test, what it gives then",
    ("present", 1): "a symptom that is there now",
    ("absent", 1): "a symptom that is known not to be there",
    ("unknown", 1): "a symptom of which nothing is known",
    ("now", 1): "the instant that is asked about: the end of the record, or --at, --to",
    ("status", 4): "component, level, from, to: what monitors said",
    ("state", 4): "component, state, from, to: nominal, not_initialised or a fault state",
    ("mission", 4): "mission, outcome, from, to",
    ("mission_name", 2): "mission, what kind it is",
    ("mission_parameter", 3): "mission, name of a parameter, its value",
    ("holds", 3): "condition, from, to: it was the case at some time",
    ("holds_throughout", 3): "condition, from, to: it was the case all the time",
}
"""What the FMEA, the monitors and the record say, with the meaning of the arguments."""
