from __future__ import annotations

from dataclasses import replace

from amberbox.diagnosis.report.explain import explain
from amberbox.diagnosis.report.explanation import MemberDiagnosis
from amberbox.diagnosis.report.text import as_text
from tests.diagnosis.report.robot import (
    BLIND,
    ENCODER,
    ODD,
    SCANS,
    STOPPED,
    WINDOW,
    diagnosis,
    explained,
    knowledge,
    symptoms,
)

TITLES = (
    "What is broken", "How sure", "Why", "What speaks against it", "What else it may be",
    "Can the robot be used", "Do this next", "Details",
)  # fmt: skip


def test_every_question_has_its_section() -> None:
    for present in (ENCODER, WINDOW, STOPPED, BLIND, SCANS, ODD):
        lines = as_text(explained(*present)).splitlines()
        titles = [line for line in lines if line in TITLES]
        assert tuple(titles) == TITLES
        assert all(lines[lines.index(title) + 1].startswith("  ") for title in TITLES)


def test_the_first_paragraph_has_no_ids() -> None:
    for present in (ENCODER, WINDOW, STOPPED, BLIND, SCANS, ODD):
        first = as_text(explained(*present)).split("\n\n")[0]
        assert not set(first) & set("#/_")
        assert "Can the robot be used?" in " ".join(first.split()) and "Next: " in first


def test_details_are_left_out_on_demand() -> None:
    told = explained(*ENCODER)
    assert as_text(told).startswith(as_text(told, details=False))
    assert "criticality" not in as_text(told, details=False)


def test_lines_are_short() -> None:
    for present in (ENCODER, WINDOW, STOPPED, BLIND, SCANS, ODD):
        assert max(map(len, as_text(explained(*present)).splitlines())) <= 88


def test_symptoms_with_the_same_reasons_are_told_together() -> None:
    text = as_text(explained(*STOPPED))
    assert text.count("cannot: give power to the") == 1
    reason, first, second = (
        text.index(part)
        for part in ("Each of them ->", "wheel_left/power/on", "wheel_right/power/on")
    )
    assert reason < first < second


def test_both_ways_are_told_where_two_faults_cost_a_function() -> None:
    text = " ".join(as_text(explained(*BLIND)).split())
    for side in ("front", "rear"):
        assert f"he {side} laser has no power -> out of service: the {side} laser" in text


def test_what_healed_is_told_in_the_past() -> None:
    seen = symptoms(knowledge(), ENCODER)
    made = replace(diagnosis(knowledge(), seen), state="healed")
    text = as_text(explain(made, knowledge(), seen))
    assert text.startswith("It was: ") and "What was broken" in text
    assert "Could the robot be used" in text


def test_of_many_measurements_some_are_told() -> None:
    (first, *others) = symptoms(knowledge(), ENCODER)
    addresses = tuple((f"sim_wheels.speed_{n}", 0, 1) for n in range(5))
    seen = (replace(first, evidence=addresses), *others)
    text = as_text(explain(diagnosis(knowledge(), seen), knowledge(), seen))
    assert "sim_wheels.speed_2 and 2 more" in " ".join(text.split())


def test_remedies_stand_by_the_answers_that_make_them_sure() -> None:
    text = " ".join(as_text(explained(*STOPPED)).split())
    assert "over 99 %; then: turn the button until it is out" in text
    assert "What helps, once it is sure: fasten the terminals." in text


def test_what_robots_of_a_team_say_is_told_early_and_where_there_is_more() -> None:
    says = MemberDiagnosis("r2", "../my r2", "open", "It is flat.", use="no", next="charge it")
    silent = MemberDiagnosis("r3", "r3", "unknown", "Nothing is known of it.")
    text = as_text(replace(explained(*ENCODER), members=(says, silent)))
    first, _, rest = " ".join(text.split()).partition(" What is broken ")
    assert "r2 says: It is flat. Can the robot be used?" in first
    assert "r3" not in first, "who has nothing to say is no news"
    assert rest.index("r3: Nothing is known of it.") < rest.index("How sure")
    assert "r2: It is flat. Can it be used? No. Next: Charge it." in rest
    assert "more: amberbox diagnose '../my r2'" in rest
    assert "say themselves" not in as_text(explained(*ENCODER))
