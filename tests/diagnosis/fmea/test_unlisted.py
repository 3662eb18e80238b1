"""Faults of a component that are not in the FMEA: what beats them, and what they beat."""

from __future__ import annotations

import random
from dataclasses import replace

import pytest

from amberbox.core.types import Symptom
from amberbox.diagnosis.covering.hypotheses import RankedHypotheses, diagnose
from amberbox.diagnosis.covering.model import UNKNOWN, Mode
from amberbox.diagnosis.covering.observations import collect_evidence
from amberbox.diagnosis.fmea.loader import read_fmea
from amberbox.diagnosis.fmea.model import Fmea
from amberbox.diagnosis.knowledge import Knowledge, compile_model
from tests.diagnosis.covering.brute import named, posterior, restricted
from tests.diagnosis.covering.small_models import random_evidence, random_model
from tests.diagnosis.fmea.small import small

TEXT = """\
other: {probability: 2.0e-5, detects: 0.01, share: 0.3}
defaults: {leak: 2.0e-5, exclusive: true}
types:
  ethercat:
    failure_modes:
      file_absent: {probability: 1.0e-4, symptoms: [file]}
      slave_lost: {probability: 3.0e-4, symptoms: [counter]}
    symptoms:
      file: {when: bus.files == 0}
      counter: {when: bus.counter < 12}
  laser:
    failure_modes:
      slow: {probability: 2.0e-4, symptoms: [late]}
      dirty: {probability: 5.0e-4, symptoms: [dim]}
      turned: {probability: 3.0e-4, symptoms: [askew]}
    symptoms:
      late: {when: scan.period > 0.11}
      dim: {when: scan.light < 0.5}
      askew: {when: scan.angle > 0.1}
  battery:
    failure_modes:
      hot:
        probability: 1.0e-3
        symptoms: [{symptom: warm, detects: 0.95, size: {uniform: [0, 20]}}]
    symptoms:
      warm: {when: battery.temp > 45, measure: battery.temp - 45, edges: [20]}
"""


def fmea(old: str = "", new: str = "") -> Fmea:
    """Return the analysis with a piece of its text changed; it must be right."""
    assert old in TEXT
    found, problems = read_fmea(TEXT.replace(old, new), None)
    assert found is not None, problems
    return found


def ranked(of: Fmea, **sizes: float | None) -> RankedHypotheses:
    """Diagnose symptoms, by name with their size; all others are absent."""
    knowledge = Knowledge("robot", of)
    symptoms = [
        Symptom(name, "present" if short in sizes else "absent", size=sizes.get(short))
        for name in of.symptoms
        for short in (name.partition(".")[2],)
    ]
    evidence = collect_evidence(symptoms, level_of=knowledge.level)
    return diagnose(knowledge.model, evidence)


def test_two_rare_causes_that_explain_all_beat_what_is_not_listed() -> None:
    two = frozenset({"ethercat#file_absent", "laser#slow"})
    best = ranked(fmea(), file=None, late=None).hypotheses[0]
    assert best.faults == two and not best.unexplained
    anywhere = "other: {probability: 2.0e-5, detects: 0.01, share: 0.3}"
    before = ranked(fmea(anywhere, "other: {}"), file=None, late=None).hypotheses[0]
    assert before.faults == {UNKNOWN} and before.probability > 0.9


def test_one_cause_that_leaves_symptoms_unexplained_does_not() -> None:
    best = ranked(fmea(), late=None, dim=None, askew=None).hypotheses[0]
    assert best.faults == {UNKNOWN}
    assert set(best.explains) == {"laser.late", "laser.dim", "laser.askew"}
    assert ranked(fmea(), late=None).hypotheses[0].faults == {"laser#slow"}


def test_a_symptom_of_another_component_is_not_explained() -> None:
    answer = ranked(fmea(), late=None, dim=None, askew=None, counter=None)
    best = answer.hypotheses[0]
    assert best.faults == {UNKNOWN, "ethercat#slave_lost"} and not best.unexplained


@pytest.mark.parametrize("size", [60.0, -12.0])
def test_a_cause_that_cannot_show_a_size_or_sign_loses(size: float) -> None:
    assert ranked(fmea(), warm=12.0).hypotheses[0].faults == {"battery#hot"}
    answer = ranked(fmea(), warm=size)
    assert answer.hypotheses[0].faults == {UNKNOWN}
    assert all("battery#hot" not in h.faults or h.unexplained for h in answer.hypotheses)


ODD = "      askew: {when: scan.angle > 0.1}\n"
CONTRADICTS = f"{ODD}      odd: {{when: scan.period * scan.rate > 1.2}}\n"


def test_a_condition_that_no_failure_mode_shows_is_that_of_an_unknown_fault() -> None:
    found = fmea(ODD, CONTRADICTS)
    assert found.unshown() == {"ethercat": (), "laser": ("laser.odd",), "battery": ()}
    assert ranked(found, late=None).hypotheses[0].faults == {"laser#slow"}
    best = ranked(found, late=None, odd=None).hypotheses[0]
    assert best.faults == {UNKNOWN} and not best.unexplained


def test_a_condition_of_another_component_is_not_that_of_an_unknown_fault() -> None:
    found = fmea(ODD, CONTRADICTS)
    best = ranked(found, odd=None, counter=None, file=None).hypotheses[0]
    shown = {
        link.cause.partition("#")[0]
        for link in compile_model(found).links
        if link.symptom == "laser.odd"
    }
    assert shown == {"laser"} and best.faults == {UNKNOWN}


def test_it_may_show_in_what_needs_the_component() -> None:
    needy = ODD.replace("askew", "odd") + "  map:\n    needs: [laser]\n    failure_modes:\n"
    needy += "      old: {probability: 1.0e-4, symptoms: [off]}\n    symptoms:\n"
    needy += "      off: {when: map.off > 1}\n      torn: {when: map.torn > 1}\n"
    found = fmea(ODD, ODD + needy)
    assert found.unshown_below()["laser"] == ("map.torn",) and not found.unshown_below()["map"]
    best = ranked(found, late=None, odd=None, torn=None).hypotheses[0]
    assert best.faults == {UNKNOWN} and not best.unexplained
    alone = fmea(ODD, ODD + needy.replace("needs: [laser]", "needs: []"))
    before = ranked(alone, late=None, odd=None, torn=None).hypotheses[0]
    assert before.probability < best.probability
    most = max(link.detects for link in compile_model(found).links if link.symptom == "map.torn")
    assert most <= 0.5


def test_the_faults_of_a_component_have_their_share() -> None:
    model = compile_model(fmea())
    prior = {mode.id: mode.prior for mode in model.modes}
    of_laser = [mode for mode in model.unlisted if mode.startswith("laser#")]
    assert sum(prior[mode] for mode in of_laser) == pytest.approx(1e-3 * 0.3 / 0.7)
    shown = {
        mode: sum(link.detects for link in model.links if link.cause == mode) for mode in of_laser
    }
    assert sorted(shown.values()) == pytest.approx([1.0, 1.5])  # never surer than 0.5 of each


def test_without_a_share_nothing_changes() -> None:
    model = compile_model(small())
    assert not model.unlisted and [mode.id for mode in model.modes] == list(small().modes)


@pytest.mark.parametrize("seed", range(50))
def test_every_probability_equals_that_of_writing_out_all_sets(seed: int) -> None:
    rng = random.Random(seed)
    model = random_model(rng)
    modes = tuple(replace(mode, is_unlisted=rng.random() < 0.4) for mode in model.modes)
    evidence = random_evidence(rng, model)
    plain = diagnose(model, evidence, max_hypotheses=5000, mass=2.0)
    answer = diagnose(replace(model, modes=modes), evidence, max_hypotheses=5000, mass=2.0)
    exact = posterior(model, evidence)
    expected: dict[frozenset[str], float] = {}
    if exact:
        for faults, share in restricted(exact, named(h.faults for h in plain.hypotheses)).items():
            own = _shown(faults, modes)
            expected[own] = expected.get(own, 0.0) + share
    ours = {h.faults: h.probability for h in answer.hypotheses}
    assert ours == pytest.approx({faults: expected[faults] for faults in ours}, abs=1e-9)
    assert [h.probability for h in answer.hypotheses] == sorted(ours.values(), reverse=True)
    assert sum(p for f, p in expected.items() if f not in ours) < 1e-9


def _shown(faults: frozenset[str], modes: tuple[Mode, ...]) -> frozenset[str]:
    unlisted = {mode.id for mode in modes if mode.is_unlisted}
    return faults - unlisted | {UNKNOWN} if faults & unlisted else faults


def test_the_sizes_of_a_file_alone_count_without_its_monitors() -> None:
    text = """\
symptoms:
  laser/heartbeat/alive: {edges: [4]}
types:
  laser:
    failure_modes:
      dead:
        probability: 0.1
        symptoms: [{symptom: laser/heartbeat/alive, size: {uniform: [0, 3]}}]
"""
    found, problems = read_fmea(text, None)
    assert found is not None, problems
    (link,) = compile_model(found).links
    assert link.sizes == (0.0, 1.0, 0.0, 0.0)
