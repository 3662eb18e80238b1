"""``findings:`` of fmea.yaml: its keys, its errors, its part of the model."""

from __future__ import annotations

import pytest

from amberbox.diagnosis.fmea.findings import causes_of, finding_instances, text_of
from amberbox.diagnosis.fmea.loader import read_fmea
from amberbox.diagnosis.fmea.model import FmeaReferences
from amberbox.diagnosis.knowledge import compile_model

TEXT = """\
instances: {base: [ropod1, ropod-2], motor: [m1, m2]}
types:
  base: {modes: {short_circuit: {probability: 0.001, unobservable: no sensor}}}
  motor: {modes: {burnt: {probability: 0.01, unobservable: no sensor}}}
findings:
"""
KNOWN = FmeaReferences(predicates=[("short_circuit", 1), ("broken", 2)])


def errors(finding: str) -> str:
    _, problems = read_fmea(TEXT + finding, KNOWN)
    return "\n".join(map(str, problems))


def test_every_instance_is_a_symptom_with_its_causes() -> None:
    text = "  - {rule: short_circuit(R), maps_to: [<R>#short_circuit], detects: 0.9, leak: 0.01}"
    fmea, problems = read_fmea(TEXT + text, KNOWN)
    assert fmea is not None
    assert problems == []
    model = compile_model(fmea)
    assert [(sign.id, sign.leak, sign.read_cost_s) for sign in model.signs] == [
        ("rule:short_circuit(ropod1)", 0.01, None),
        ("rule:short_circuit('ropod-2')", 0.01, None),
    ]
    assert [(link.cause, link.symptom, link.detects) for link in model.links] == [
        ("ropod1#short_circuit", "rule:short_circuit(ropod1)", 0.9),
        ("ropod-2#short_circuit", "rule:short_circuit('ropod-2')", 0.9),
    ]


def test_variables_that_map_to_nothing_do_not_make_more_symptoms() -> None:
    text = "  - {rule: 'broken(M, _Why)', maps_to: [<M>#burnt, ropod1#short_circuit]}"
    fmea, _ = read_fmea(TEXT + text, KNOWN)
    assert fmea is not None
    assert dict(finding_instances(fmea.findings[0], fmea.modes)) == {
        "rule:broken(m1,_)": ("m1#burnt", "ropod1#short_circuit"),
        "rule:broken(m2,_)": ("m2#burnt", "ropod1#short_circuit"),
    }


def test_findings_are_described_by_their_symptoms() -> None:
    text = """\
  - {rule: short_circuit(R), maps_to: [<R>#short_circuit], detects: 0.9, description: a short}
  - {finding: flow.unlikely.<M>, maps_to: [<M>#burnt]}
"""
    fmea, _ = read_fmea(TEXT + text, KNOWN)
    assert fmea is not None
    assert text_of(fmea, "rule:short_circuit(ropod1)") == "a short (rule short_circuit(ropod1))"
    assert text_of(fmea, "flow.unlikely.m1") == "finding flow.unlikely.m1"
    assert text_of(fmea, "a/b/c") == ""
    assert causes_of(fmea, "rule:short_circuit(ropod1)") == {"ropod1#short_circuit": 0.9}
    assert causes_of(fmea, "a/b/c") == {}


def test_a_detectors_finding_and_a_proof() -> None:
    text = """\
  - {finding: flow.unlikely.<M>, maps_to: [<M>#burnt], detects: 0.7}
  - {rule: 'broken(X, Y)', maps_to: [<X>#burnt], proves: true}
"""
    fmea, problems = read_fmea(TEXT + text, KNOWN)
    assert fmea is not None
    assert problems == []
    model = compile_model(fmea)
    assert [sign.id for sign in model.signs] == ["flow.unlikely.m1", "flow.unlikely.m2"]


@pytest.mark.parametrize(
    ("finding", "message"),
    [
        ("  - {rule: short_circut(X), maps_to: [<X>#short_circuit]}",
         "fmea.yaml:6: findings[0].rule: there is no rule short_circut/1; did you mean"),
        ("  - {rule: short_circuit(X), maps_to: [m1#brunt]}", "did you mean 'm1#burnt'?"),
        ("  - {rule: short_circuit(X), maps_to: [<X>#burned]}", "no failure mode '<X>#burned'"),
        ("  - {rule: short_circuit(Robot), maps_to: [<Robt>#burnt]}", "did you mean 'Robot'?"),
        ("  - {rule: 'short_circuit(X), x(X)', maps_to: [m1#burnt]}", "is not one goal"),
        ("  - {rule: 'short_circuit(', maps_to: [m1#burnt]}", "findings[0].rule: "),
        ("  - {rule: short_circuit(X), finding: x, maps_to: [m1#burnt]}", "either 'rule' or"),
        ("  - {rule: short_circuit(X), maps_to: [m1#burnt], detects: 2}", "2 is above 1"),
        ("  - {rule: short_circuit(X), proves: true}", "what does it prove?"),
        ("  - {rule: short_circuit(X), maps_to: [m1#burnt], proves: true, detects: 1}",
         "what is proven has no probability"),
        ("  - {rule: short_circuit(X), map_to: [m1#burnt]}", "did you mean 'maps_to'?"),
        ("  - {finding: flow/<1>, maps_to: [<1>#burnt]}", "no failure mode '<1>#burnt'"),
        ("  {rule: short_circuit(X)}", "findings: expected a list"),
    ],
)  # fmt: skip
def test_what_is_wrong(finding: str, message: str) -> None:
    assert message in errors(finding)


def test_a_finding_is_enough_to_show_a_failure_mode() -> None:
    text = TEXT.replace(", unobservable: no sensor", "", 1)
    finding = "  - {rule: short_circuit(R), maps_to: [<R>#short_circuit]}"
    assert read_fmea(text + finding)[1] == []
    told = read_fmea(text + finding.replace("<R>", "ropod1"))[1]
    assert [problem.where for problem in told] == ["short_circuit"]


def test_notes_name_what_moves_nothing() -> None:
    known = FmeaReferences(
        predicates=[("p", 0)], heads={("q", 1): ("rules/a.pl", 7), ("p", 0): ("b", 1)}
    )
    fmea, problems = read_fmea(TEXT + "  - {rule: p}", known)
    assert fmea is not None
    notes = [str(problem) for problem in problems]
    assert notes[0].startswith("fmea.yaml:6: note: findings[0]: speaks for no failure mode")
    assert notes[1].startswith("rules/a.pl:7: note: findings: answers of q/1 are not used")
