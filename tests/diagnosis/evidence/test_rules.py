"""What rules find: evidence that counts once, conflicts, conclusions of their own."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from amberbox.core.types import Symptom
from amberbox.diagnosis.diagnose import (
    DiagnosisId,
    ObservedSituation,
    answer,
    evidence_of_situation,
)
from amberbox.diagnosis.evidence.rules import (
    Facts,
    conclude,
    fmea_facts,
    rule_findings,
    seen_facts,
)
from amberbox.diagnosis.fmea.loader import read_fmea
from amberbox.diagnosis.fmea.model import Fmea
from amberbox.diagnosis.knowledge import Knowledge
from amberbox.diagnosis.prolog.machine import LookupSource, SourcedRow, Virtual
from amberbox.diagnosis.prolog.program import Program, read_rules, read_text
from amberbox.diagnosis.prolog.query import ask
from amberbox.diagnosis.prolog.terms import RuleError

TEXT = """\
instances: {base: [ropod1, ropod2], motor: [m1, m2]}
types:
  base:
    modes: {short_circuit: {probability: 0.001, severity: fatal, symptoms: [<component>/power/on]}}
  motor: {modes: {burnt: {probability: 0.01, cause: heat, symptoms: [<component>/turns/freely]}}}
functions: {drive: {needs: [ropod1, {any: [m1, m2]}], system: true}}
findings:
  - {rule: short_circuit(R), maps_to: [<R>#short_circuit]}
  - {rule: broken(X), maps_to: [<X>#burnt], proves: true}
  - {rule: strange(X), description: nobody knows}
"""
RULES = """\
broken(X) :- hot(X), shows(X, burnt, Symptom), present(Symptom).
short_circuit(R) :- component(R), present(S), atom_concat(R, '/power/on', S).
strange(X) :- unknown(X).
lonely(X) :- type(X, base).
hot(m1). hot(m2).
"""
HEADING = DiagnosisId("d", 1, 9)


def fmea_of(text: str = TEXT) -> Fmea:
    fmea, problems = read_fmea(text)
    assert fmea is not None, problems
    return fmea


FMEA = fmea_of()
PROGRAM = read_text(RULES)


def seen(*names: str) -> tuple[Symptom, ...]:
    return tuple(
        Symptom(name, "present", name, 3, 5, evidence=((f"item.{name}", 2, 5),)) for name in names
    )


def facts(*symptoms: Symptom) -> Facts:
    return Facts(tuple(fmea_facts(FMEA)), tuple(seen_facts(symptoms, FMEA)))


def test_answers_are_symptoms_conflicts_and_texts() -> None:
    found = rule_findings(PROGRAM, FMEA, facts(*seen("ropod2/power/on", "m1/turns/freely")), 9)
    (symptom,) = found.symptoms
    assert (symptom.id, symptom.state, symptom.source) == (
        "rule:short_circuit(ropod2)", "present", "rules",
    )  # fmt: skip
    assert symptom.evidence == (("item.ropod2/power/on", 2, 5),)
    assert (symptom.onset_ns, symptom.confirmed_ns) == (2, 9)
    assert found.conflicts == (frozenset({"m1#burnt"}),)
    assert found.findings == (
        "rule:strange('m2/turns/freely'): nobody knows",
        "rule:strange('ropod1/power/on'): nobody knows",
    )
    assert "hot(m1)   fact, rules.pl:5" in found.proofs["m1#burnt"]
    assert "present('ropod2/power/on')   fact, symptoms:1" in found.proofs[symptom.id]


def test_one_measurement_counts_once() -> None:
    symptoms = seen("ropod2/power/on")
    found = rule_findings(PROGRAM, FMEA, facts(*symptoms), 9)
    knowledge = Knowledge("r", FMEA)
    both = evidence_of_situation(knowledge, ObservedSituation(symptoms).with_items(found.items()))
    assert set(both.observations) == {"ropod2/power/on"}
    assert both.doubled == ("rule:short_circuit(ropod2)",)
    alone = evidence_of_situation(knowledge, ObservedSituation().with_items(found.items()))
    assert set(alone.observations) == {"rule:short_circuit(ropod2)"}


def test_it_counts_once_without_evidence_of_its_own() -> None:
    told = Symptom("ropod2/power/on", "present", "ropod2/power/on", 4, 4)
    found = rule_findings(PROGRAM, FMEA, facts(told), 9)
    both = evidence_of_situation(
        Knowledge("r", FMEA), ObservedSituation((told,)).with_items(found.items())
    )
    assert set(both.observations) == {"ropod2/power/on"}


def test_what_is_blocked_is_unknown() -> None:
    blocked = Symptom("m1/turns/freely", "present", blocked_by=("bus",))
    assert rule_findings(PROGRAM, FMEA, facts(blocked), 9).conflicts == ()


def test_the_answer_takes_them_all() -> None:
    found = rule_findings(PROGRAM, FMEA, facts(*seen("m1/turns/freely")), 9)
    situation = ObservedSituation().with_items(found.items())
    diagnosis = answer(Knowledge("r", FMEA), situation, HEADING)
    assert all("m1#burnt" in hypothesis.faults for hypothesis in diagnosis.hypotheses)
    assert any(text.startswith("rule:strange(") for text in diagnosis.findings)


def test_rules_alone_conclude_with_proofs() -> None:
    known = facts(*seen("ropod2/power/on"))
    diagnosis = conclude(Knowledge("r", FMEA), PROGRAM, known, HEADING)
    (hypothesis,) = diagnosis.hypotheses
    assert hypothesis.faults == {"ropod2#short_circuit"}
    assert hypothesis.explains == ("rule:short_circuit(ropod2)",)
    assert hypothesis.proof.startswith("short_circuit(ropod2)   rule, rules.pl:2\n")
    assert {"rule:lonely(ropod1)", "rule:lonely(ropod2)"} <= set(diagnosis.findings)
    nothing = conclude(Knowledge("r", FMEA), PROGRAM, facts(), HEADING)
    assert nothing.hypotheses == ()


def test_a_goal_that_cannot_be_answered_is_named() -> None:
    text = TEXT + "  - {rule: late(X), maps_to: [m1#burnt]}\n"
    program = read_text("late(X) :- X > 3. broken(x). short_circuit(x). strange(x).")
    found = rule_findings(program, fmea_of(text), Facts(), 9)
    assert found.symptoms == ()
    assert found.findings[-1].startswith("rule:late(X): not answered: rules.pl:1: ")
    assert "rule:broken(x)" in found.findings  # there is no such failure mode


def test_facts_of_the_fmea() -> None:
    program = facts().added_to(read_text(""))
    for goal in (
        "component(m1)", "type(m1, motor)", "function(drive)", "needs(drive, m2)",
        "failure_mode(m1, burnt)", "severity(ropod1, short_circuit, fatal)",
        "probability(m1, burnt, P), P =:= 0.01", "cause(m1, burnt, heat)",
        "effect(ropod1, short_circuit, drive)", "shows(m1, burnt, 'm1/turns/freely')",
        "symptom('m1/turns/freely')", "unknown('m1/turns/freely')",
    ):  # fmt: skip
        assert ask(program, goal).answers, goal


def test_a_lookup_and_a_file_do_not_define_the_same() -> None:
    lookup = Virtual("mission", 4, lambda _: [])
    with pytest.raises(RuleError, match=r"rules.pl:1: mission/4 is looked up in the record"):
        Facts(lookups=(lookup,)).added_to(read_text("mission(a, b, 1, 2)."))


@pytest.mark.needs_data
def test_the_rules_of_the_paper(shared_data: Path) -> None:
    folder = shared_data / "diagnosis" / "rules"
    program = read_rules([folder / "facts.pl", folder / "paper_rules.pl"])
    diagnosis = conclude(Knowledge("team", FMEA), program, Facts(), HEADING)
    faults = diagnosis.hypotheses[0].faults
    assert faults == {"m1#burnt", "m2#burnt", "ropod2#short_circuit"}
    assert "initialisation_shutdown(ropod2)" in diagnosis.hypotheses[0].proof


def test_rules_like_those_of_the_paper() -> None:
    program: Program = read_text("""\
robot(ropod2). driver_initialising(ropod2). initialisation_shutdown(ropod2).
short_circuit(X) :- robot(X), driver_initialising(X), initialisation_shutdown(X).
""")
    diagnosis = conclude(Knowledge("team", FMEA), program, Facts(), HEADING)
    assert diagnosis.hypotheses[0].faults == {"ropod2#short_circuit"}


DATED = """\
short_circuit(R) :- component(R), present(S), atom_concat(R, '/power/on', S), REST.
broken(x). strange(x).
"""


@pytest.mark.parametrize(
    ("rest", "onset_ns"),
    [
        ("true", 40),
        ("present('m1/turns/freely')", 70),
        ("present('m2/turns/freely')", 40),
        ("absent('ropod1/power/on')", 40),
        ("held(old, 10, 95)", 40),
        ("held(new, F, T)", 60),
    ],
)
def test_a_finding_begins_with_the_last_of_its_goals(rest: str, onset_ns: int) -> None:
    """An absent symptom has no onset."""
    present = [("ropod2/power/on", 40), ("m1/turns/freely", 70), ("m2/turns/freely", 20)]
    symptoms = [
        Symptom(name, "present", name, at, 90, evidence=((f"item.{name}", at, 90),))
        for name, at in present
    ]
    gone = (("item.gone", 80, 90),)
    symptoms.append(Symptom("ropod1/power/on", "absent", "", 80, 80, evidence=gone))
    spans = {"old": (10, 95), "new": (60, 95)}
    rows = [
        SourcedRow((name, *span), LookupSource("record", ((f"item.{name}", *span),)))
        for name, span in spans.items()
    ]
    known = replace(facts(*symptoms), lookups=(Virtual("held", 3, lambda _: rows),))
    found = rule_findings(read_text(DATED.replace("REST", rest)), FMEA, known, 99)
    (symptom,) = found.symptoms
    assert (symptom.id, symptom.onset_ns) == ("rule:short_circuit(ropod2)", onset_ns)
