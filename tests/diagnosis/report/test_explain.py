from __future__ import annotations

from dataclasses import replace

import pytest

from amberbox.core.contracts import Budget
from amberbox.core.types import Diagnosis, Hypothesis
from amberbox.core.types import Test as Proposed
from amberbox.diagnosis.covering.hypotheses import diagnose
from amberbox.diagnosis.covering.next_test import with_answer
from amberbox.diagnosis.diagnose import (
    Effort,
    ObservedSituation,
    check_named,
    evidence_of_situation,
)
from amberbox.diagnosis.report.explain import ANSWERS, NOTHING, UNKNOWN_USE, explain
from tests.diagnosis.report.robot import (
    BLIND,
    ENCODER,
    ODD,
    SCANS,
    START_NS,
    STOPPED,
    WINDOW,
    diagnosis,
    explained,
    knowledge,
    symptoms,
)


def test_a_single_fault_is_named_by_its_description() -> None:
    told = explained(*ENCODER)
    assert told.headline == (
        "The encoder of drive 1 of the left wheel unit stands still. Almost certain (over 99 %)."
    )
    assert told.broken is not None and len(told.broken.members) == 1
    (fault,) = told.broken.members[0].faults
    assert (fault.id, fault.severity) == ("wheel_left#encoder_stuck", "critical")
    assert fault.cause == "broken disc or cable"


def test_why_has_addresses_times_and_what_was_measured() -> None:
    first, second = explained(*ENCODER).because
    assert first.text == 'the left wheel unit: the self-check "encoders: encoder 1" fails'
    assert (first.address, first.onset_ns, first.after_s) == (ENCODER[0], START_NS, 0.0)
    assert (second.after_s, second.measured_from) == (0.5, ("sim_wheel_left.value",))
    assert [(way.fault, way.via, way.detects) for way in first.ways] == [
        ("wheel_left#encoder_stuck", (), 0.98)
    ]


def test_a_mode_and_an_output_of_one_name_are_said_once() -> None:
    assert explained(*ENCODER).because[1].text.endswith('"rolls smoothly" fails')


def test_what_should_show_and_does_not_speaks_against_it() -> None:
    (missing,) = explained(*ENCODER).against
    assert missing.text == "the left wheel unit takes more current than the other"
    assert missing.id == "wheel_left.pulls_harder"


def test_one_of_two_and_the_test_that_splits_them() -> None:
    told = explained(*WINDOW)
    assert told.headline.startswith(
        "One of: something covers the window of the front laser; or the window of the front"
    )
    assert (told.next.test, told.next.splits) == ("laser_front.window", True)
    assert (told.next.by, told.next.takes, told.next.risk) == ("operator", "1 min", "")
    assert [branch.answer for branch in told.next.answers] == ["clean", "dirty", "covered"]


@pytest.mark.parametrize("present", [WINDOW, STOPPED, ODD])
def test_answers_mean_what_the_engine_makes_of_them(present: tuple[str, ...]) -> None:
    of = knowledge()
    known = evidence_of_situation(of, ObservedSituation(symptoms(of, present)))
    told = explained(*present)
    check = check_named(of, told.next.test)
    assert sum(branch.probability for branch in told.next.answers) == pytest.approx(1)
    for branch in told.next.answers:
        best = diagnose(of.model, with_answer(known, check, branch.answer), mass=1).hypotheses[0]
        if branch.then > 0.6:  # less, and what was not listed before may lead
            texts = [of.fmea.modes[f].description for f in best.faults if f in of.fmea.modes]
            assert all(text in branch.leads for text in texts)
            assert branch.then == pytest.approx(best.probability, abs=0.05)


def test_the_loss_of_a_function_is_a_reason() -> None:
    told = explained(*STOPPED)
    ways = {seen.id: seen.ways for seen in told.because}
    assert {way.via for way in ways["wheel_left/power/on"]} == {("safety", "power_drives")}
    assert ways["wheel_left/power/on"][0].text == (
        "out of service: the emergency stop -> cannot: give power to the drives"
    )
    assert all(way.via == () for way in ways["safety/button/released"])


def test_both_faults_are_named_where_only_both_cost_a_function() -> None:
    told = explained(*BLIND)
    assert told.broken is not None
    assert told.broken.text == (
        "the front laser has no power and the rear laser has no power (both together)"
    )
    (scans,) = (seen for seen in told.because if seen.id == "log/navigation/has_scans")
    assert {way.via[0] for way in scans.ways} == {"laser_front", "laser_rear"}
    assert [lost.id for lost in told.use.lost] == ["see_people"]
    assert (told.use.severity, told.use.text) == ("critical", ANSWERS["critical"])


def test_a_spare_keeps_the_function() -> None:
    told = explained("laser_front/heartbeat/alive")
    assert told.broken is not None and told.broken.members[0].id == "laser_front#silent"
    assert (told.use.severity, told.use.lost) == ("urgent", ())


def test_the_worst_of_what_may_be_counts() -> None:
    use = explained(*WINDOW).use
    assert (use.severity, use.text) == ("urgent", f"at worst: {ANSWERS['urgent']}")
    assert explained(*STOPPED).use.text == ANSWERS["fatal"]


def test_something_graver_that_may_be_is_warned_of() -> None:
    seen = symptoms(knowledge(), WINDOW)
    made = diagnosis(knowledge(), seen)
    pressed = Hypothesis("safety#pressed", frozenset({"safety#pressed"}), 0.2)
    told = explain(replace(made, hypotheses=(*made.hypotheses, pressed)), knowledge(), seen)
    assert told.use.severity == "urgent"
    assert "somebody has pressed the emergency stop (20 %)" in told.use.careful
    assert told.use.careful.endswith(ANSWERS["fatal"])
    assert explained(*WINDOW).use.careful == ""


def test_what_the_fmea_does_not_know() -> None:
    told = explained(*ODD)
    assert told.headline.startswith("Something that the FMEA does not know is broken.")
    assert (told.use.severity, told.use.text) == ("", UNKNOWN_USE)


@pytest.mark.parametrize("looks_like", [0.03, 0.0])
def test_what_is_not_in_the_fmea_looks_like_several_faults_at_once(looks_like: float) -> None:
    of = knowledge()
    other = replace(of.fmea.other, looks_like=looks_like)
    of = replace(of, fmea=replace(of.fmea, other=other))
    alike = frozenset({"wheel_left#encoder_stuck", "laser_front#silent", "laser_rear#silent"})
    found = (
        Hypothesis("unknown#other", frozenset({"unknown#other"}), 0.9),
        Hypothesis("two", frozenset({"laser_front#silent", "laser_rear#silent"}), 0.06),
        Hypothesis("three", alike, 0.04),
    )
    told = explain(Diagnosis("d", 1, "ropod_001", START_NS, "", found, 1.0), of, ())
    assert told.sure.note == (
        "it looks like the front laser has no power, the rear laser has no power and the encoder "
        "of drive 1 of the left wheel unit stands still at once, which have no cause in common "
        "that the FMEA knows"
        if looks_like
        else ""
    )


def test_what_is_known_to_be_lost_counts_beside_what_is_not_known() -> None:
    of, faults = knowledge(), frozenset({"safety#pressed", "unknown#other"})
    both = Hypothesis(" + ".join(sorted(faults)), faults, 0.9)
    made = Diagnosis("d", 1, "ropod_001", START_NS, "", (both,), 1.0)
    assert explain(made, of, ()).use.text == ANSWERS["fatal"]


def test_a_reading_that_may_be_taken_names_the_symptom_and_its_answers() -> None:
    of = knowledge()
    seen = symptoms(of, [ENCODER[1]], rest=False)
    step = explain(diagnosis(of, seen), of, seen).next
    assert step.test.startswith("read:wheel_left")
    assert step.text.startswith("Find out whether this shows: the left wheel unit")
    assert [branch.answer for branch in step.answers] == ["absent", "present"]


def test_a_false_alarm() -> None:
    told = explained(*SCANS)
    assert told.headline == "Probably a false alarm (over 99 %)."
    assert [seen.id for seen in told.unexplained] == list(SCANS)
    assert (told.because, told.use.severity) == ((), "")
    assert told.next.text.startswith("Nothing for now")


def test_what_has_healed_tells_when() -> None:
    seen = symptoms(knowledge(), ENCODER)
    made = replace(diagnosis(knowledge(), seen), state="healed", at_ns=START_NS + 300 * 10**9)
    end = "All symptoms have healed since"
    told = explain(made, knowledge(), seen)
    assert told.headline.startswith("It was: the encoder of drive 1")
    assert told.headline.endswith(f"{end} 00:05:00 UTC.")
    gone = [replace(s, state="absent", confirmed_ns=START_NS + 90 * 10**9) for s in seen]
    assert explain(made, knowledge(), gone).headline.endswith(f"{end} 00:01:30 UTC.")


def test_a_budget_that_ran_out_is_told_and_makes_less_sure() -> None:
    seen = symptoms(knowledge(), BLIND, rest=False)
    made = diagnosis(knowledge(), seen, effort=Effort(budget=Budget(nodes=3)))
    assert made.incomplete and made.mass_covered < 0.9
    sure = explain(made, knowledge(), seen).sure
    assert sure.at_least == pytest.approx(sure.probability * made.mass_covered)
    assert made.incomplete in sure.note and sure.note.startswith("not all possibilities")


def test_all_looked_at_needs_no_note() -> None:
    assert explained(*ENCODER).sure.note == ""


def test_findings_and_blocked_symptoms_are_told_and_do_not_count() -> None:
    of, name = knowledge(), "laser_rear/heartbeat/alive"
    found = replace(symptoms(of, ["strange/new/thing"], rest=False)[0], onset_ns=START_NS - 1)
    seen = (*symptoms(of, ENCODER, rest=False), found)
    blocked = replace(symptoms(of, [name], rest=False)[0], blocked_by=("host",))
    told = explain(diagnosis(of, (*seen, blocked)), of, (*seen, blocked))
    assert told.unknown == ("strange/new/thing",)
    assert [s.id for s in told.blocked] == [name]
    assert name not in {s.id for s in (*told.because, *told.unexplained)}


def test_nothing_explains_it() -> None:
    made = Diagnosis("d", 1, "ropod_001", START_NS, "", (), 1.0, symptoms=("a/b/c",))
    told = explain(made, knowledge(), ())
    assert told.broken is None and told.headline.lower() == f"{NOTHING}."
    assert [seen.id for seen in told.unexplained] == ["a/b/c"]
    assert told.use.text == UNKNOWN_USE


def test_faults_and_tests_of_others_are_called_by_their_ids() -> None:
    strange = Hypothesis("arm#bent_hard", frozenset({"arm#bent_hard"}), 0.9, proof="rule 7")
    test = Proposed("wave", "unit_test", "Wave the arm.")
    made = Diagnosis(
        "d", 1, "ropod_001", START_NS, "", (strange,), 1.0, next_tests=(test,),
    )  # fmt: skip
    told = explain(made, knowledge(), ())
    assert told.headline.startswith("Arm: bent hard.")
    assert any("proof: rule 7" in line for line in told.details)
    assert told.next.test == "" and told.use.text == UNKNOWN_USE


def test_details_have_every_hypothesis_with_its_criticality() -> None:
    seen = symptoms(knowledge(), WINDOW)
    made = diagnosis(knowledge(), seen)
    text = "\n".join(explain(made, knowledge(), seen).details)
    for hypothesis in made.hypotheses:
        assert f"{hypothesis.id}: probability {hypothesis.probability:.6g}" in text
    assert "criticality 0.00144" in text and "c0ffee" in text


def test_the_same_is_told_again() -> None:
    assert explained(*STOPPED) == explained(*STOPPED)
