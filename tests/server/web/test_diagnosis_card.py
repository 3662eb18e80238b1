"""The card of a diagnosis, made from answers of the engine."""

from dataclasses import replace
from html import unescape
from typing import Any

import pytest

from amberbox.core.types import Symptom
from amberbox.diagnosis.diagnose import DiagnosisContext, ObservedSituation, diagnose_context
from amberbox.diagnosis.knowledge import Knowledge
from amberbox.diagnosis.report.serialiser import context_json, explain_context
from amberbox.server.knowledge.diagnoses import SymptomInterval
from amberbox.server.services.knowledge import revision_json
from amberbox.server.web.diagnosis_card import (
    REASONS,
    DiagnosisCard,
    card_of,
    minutes,
    plain_card_of,
)
from amberbox.server.web.page import environment
from amberbox.server.web.text import moment_href
from tests.server.knowledge import robot as sim

NOW = sim.AT_NS
SECOND_NS = 1_000_000_000
NO_POWER = "The front laser has no power"


@pytest.fixture(scope="module")
def knowledge() -> Knowledge:
    return sim.knowledge()


def seen(name: str, *addresses: str, at_ns: int = NOW) -> Symptom:
    evidence = tuple((address, at_ns, at_ns) for address in addresses)
    return Symptom(name, "present", name, at_ns, at_ns, evidence=evidence)


def answer_of(knowledge: Knowledge, *symptoms: Symptom, **answers: str) -> dict[str, Any]:
    given = {name.replace("__", "."): value for name, value in answers.items()}
    case = DiagnosisContext(NOW, ObservedSituation(symptoms, watched=True, answers=given))
    found = diagnose_context(knowledge, case) if symptoms else None
    return context_json(knowledge, case, found, explain_context(knowledge, case, found))


def card(knowledge: Knowledge, *symptoms: Symptom, **answers: str) -> DiagnosisCard:
    return card_of(answer_of(knowledge, *symptoms, **answers))


def shown(found: DiagnosisCard, raw: bool = False) -> str:
    """Return the card as a page has it; ``raw`` with its escapes."""
    template = environment().get_template("diagnosis/part.html")
    page = template.render(shown=found, seen=None, may=True, link=True)
    return page if raw else unescape(page)


def test_two_that_nothing_tells_apart_are_named_both(knowledge: Knowledge) -> None:
    found = card(knowledge, seen(sim.NO_SCANS))
    assert {cause.text for cause in found.causes} == {
        "The driver of the front laser has ended", NO_POWER,
    }  # fmt: skip
    assert (found.sure, found.number) == ("cannot_tell_apart", "87 %")


def test_an_answer_makes_one_likely(knowledge: Knowledge) -> None:
    found = card(knowledge, seen(sim.NO_SCANS), laser_front__lamp="no")
    assert [cause.text for cause in found.causes] == [NO_POWER]
    assert (found.sure, found.number) == ("likely", "97 %")


def test_below_one_in_two_it_is_only_possible(knowledge: Knowledge) -> None:
    answer = answer_of(knowledge, seen(sim.NO_SCANS), laser_front__lamp="no")
    answer["explanation"]["sure"]["probability"] = 0.4999
    assert card_of(answer).sure == "possible"


def test_it_says_whether_the_robot_can_be_used_on_one_scale(knowledge: Knowledge) -> None:
    found = card(knowledge, seen(sim.NO_SCANS))
    assert (found.severity, found.use) == ("critical", "No, it cannot go on with what it does.")


def test_the_next_test_has_minutes_somebody_and_answers_in_order(knowledge: Knowledge) -> None:
    step = card(knowledge, seen(sim.NO_SCANS)).next
    assert step is not None
    assert (step.text, step.role, step.minutes) == (
        "Does the lamp of the front laser burn?", "operator", "½",
    )  # fmt: skip
    assert [choice.value for choice in step.choices] == ["yes", "no"]
    assert step.choices[1].leads == "the front laser has no power"


def test_reasons_lead_to_the_data_of_their_moment(knowledge: Knowledge) -> None:
    at_ns = NOW - 5 * SECOND_NS
    symptom = seen(sim.NO_SCANS, "sim_scan_front", "sim_bus.devices", at_ns=at_ns)
    (reason,) = card(knowledge, symptom).why
    assert reason.at == "2027-01-15T07:43:15.000000000Z"
    assert reason.href == (
        "/robots/ropod_001/data?v=sim_scan_front&v=sim_bus.devices"
        "&from=2027-01-15T07%3A42%3A15.000Z&to=2027-01-15T07%3A44%3A15.000Z"
    )


def test_there_are_at_most_three_reasons_and_a_count_of_the_others(knowledge: Knowledge) -> None:
    answer = answer_of(knowledge, seen(sim.NO_SCANS))
    answer["explanation"]["because"] *= REASONS + 2
    found = card_of(answer)
    assert (len(found.why), found.more) == (REASONS, 2)


def test_nothing_open_is_nothing_known_to_be_broken(knowledge: Knowledge) -> None:
    found = card(knowledge)
    assert (found.state, found.causes, found.next) == ("none", (), None)
    assert found.at == "2027-01-15T07:43:20.000000000Z"


def test_a_false_alarm_and_what_nobody_knows_are_called_so(knowledge: Knowledge) -> None:
    answer = answer_of(knowledge, seen(sim.NO_SCANS), laser_front__lamp="no")
    member = answer["explanation"]["broken"]["members"][0]
    fault = member["faults"][0]
    answer["explanation"]["broken"]["members"] = [
        {**member, "faults": []}, {**member, "faults": [{**fault, "id": "unknown#other"}]},
    ]  # fmt: skip
    assert [cause.kind for cause in card_of(answer).causes] == ["false_alarm", "other"]


def test_without_any_explanation_the_revision_speaks_by_ids() -> None:
    found = plain_card_of(revision_json(sim.diagnosis(NOW, seen(sim.NO_SCANS))))
    assert [cause.text for cause in found.causes] == [
        "Laser front: driver crash", "Laser front: silent",
    ]  # fmt: skip
    assert not found.complete and found.next is not None
    assert [choice.value for choice in found.next.choices] == ["yes", "no"]
    assert found.why[0].text == "Laser front: “heartbeat: alive” fails."


def test_a_revision_without_any_hypothesis_has_a_card() -> None:
    shown = revision_json(sim.diagnosis(NOW, seen(sim.NO_SCANS)))
    found = plain_card_of({**shown, "hypotheses": [], "groups": [], "next_tests": []})
    assert (found.causes, found.sure, found.next) == ((), "", None)


def test_whatever_stands_in_a_robots_folder_is_shown_as_text(knowledge: Knowledge) -> None:
    hostile = '"><img src=x onerror=alert(1)>{{7777*7777}}'
    answer = answer_of(knowledge, seen(sim.NO_SCANS, hostile))
    told = answer["explanation"]
    told["broken"]["members"][0]["text"] = told["because"][0]["text"] = hostile
    told["next"].update(text=hostile, test=hostile, by=hostile)
    told["next"]["answers"][0]["answer"] = told["use"]["text"] = hostile
    answer["id"] = answer["robot"] = answer["notes"] = hostile
    page = shown(card_of(answer), raw=True)
    assert "<img" not in page and "60481729" not in page
    assert page.count("&lt;img src=x onerror=alert(1)&gt;{{7777*7777}}") >= 6


def test_an_experiment_has_a_link_to_its_page(knowledge: Knowledge) -> None:
    answer = answer_of(knowledge, seen(sim.NO_SCANS))
    answer["explanation"]["next"].update(test="pivots", kind="experiment", run='pivot"check')
    found = card_of(answer)
    about = f"?diagnosis={found.diagnosis}&test=pivots"
    href = f"/robots/{found.robot}/experiments/pivot%22check{about}"
    assert f'href="{href}"' in shown(found)


@pytest.mark.parametrize(
    ("seconds", "text"), [(0, ""), (20, "½"), (60, "1"), (89, "1"), (150, "2"), (3600, "60")]
)
def test_minutes_are_whole_but_for_a_half(seconds: float, text: str) -> None:
    assert minutes(seconds) == text


def test_addresses_of_data_are_quoted_and_those_of_monitors_left_out() -> None:
    hostile = '"><script>'
    found = moment_href("a/b", [hostile, "laser/heartbeat/alive"], None)
    assert found == "/robots/a%2Fb/data?v=%22%3E%3Cscript%3E"


HEATS, JUMPS = "battery.heats", "localisation/position/does_not_jump"


def overheating(knowledge: Knowledge) -> DiagnosisCard:
    """Return the card of a battery that heats itself, after the robot was lost on the map."""
    lost = seen(JUMPS, at_ns=NOW - 30 * SECOND_NS)
    return replace(card(knowledge, lost, seen(HEATS)), state="open")


def test_a_dangerous_cause_is_made_safe_before_anything_is_asked(knowledge: Knowledge) -> None:
    found = overheating(knowledge)
    assert found.next is not None
    (safe,) = found.next.make_safe
    assert safe.text == "Switch off, let it cool outside."
    assert safe.why.startswith("The battery heats itself, ")
    assert HEATS in [reason.small for reason in found.why]
    html = shown(found)
    assert html.index(safe.text) < html.index("Why") < html.index(found.next.text)


def test_in_the_robots_own_words_it_is_made_safe_first_as_well(knowledge: Knowledge) -> None:
    case = DiagnosisContext(NOW, ObservedSituation((seen(JUMPS), seen(HEATS)), watched=True))
    found = diagnose_context(knowledge, case)
    assert found is not None
    plain = plain_card_of(revision_json(found))
    assert plain.next is not None and plain.next.make_safe
    html = shown(plain)
    assert html.index(plain.next.make_safe[0].text) < html.index(plain.next.text)


def test_a_repaired_cause_leaves_the_title_and_stands_apart(knowledge: Knowledge) -> None:
    found = overheating(knowledge)
    assert len(found.causes[0].parts) == 2
    over = found.held({JUMPS: SymptomInterval(NOW - 30 * SECOND_NS, NOW)})
    assert [cause.text for cause in over.causes] == ["The battery heats itself"]
    assert [one.id for one in over.cleared] == ["localisation#shift"]
    assert [reason.small for reason in over.why] == [HEATS, JUMPS]
    assert found.next is not None and found.next.test == "place_on_map"
    assert over.next is not None and over.next.text == "Replace the battery."
    assert over.next.test == "" and float(over.number[:2]) > float(found.number[:2])
    html = shown(over)
    assert html.index("The battery heats itself") < html.index("shows no more")
    back = over.held({JUMPS: SymptomInterval(NOW, None)})
    assert len(back.cleared) == 0 and "map" not in back.causes[0].text
    assert " and " in back.causes[0].text


def test_what_may_catch_fire_is_made_safe_also_when_it_shows_no_more(knowledge: Knowledge) -> None:
    over = overheating(knowledge).held({HEATS: SymptomInterval(NOW, NOW + SECOND_NS)})
    assert [one.id for one in over.cleared] == ["battery#overheats"]
    assert over.next is not None and over.next.make_safe


def test_which_instance_it_is_is_one_question_with_one_answer(knowledge: Knowledge) -> None:
    found = card(knowledge, seen("localisation/match/scans_fit_map"))
    assert found.next is not None and found.next.text.startswith("Which one is it? ")
    *some, none = found.next.choices
    assert {(one.test, one.value) for one in some} == {
        ("laser_front.lamp", "no"), ("laser_rear.lamp", "no"),
    }  # fmt: skip
    all_sound = {none.test: none.value, **none.also}
    assert all_sound == {"laser_front.lamp": "yes", "laser_rear.lamp": "yes"}
    assert "Rear: no" in shown(found)
    given = {test.replace(".", "__"): answer for test, answer in all_sound.items()}
    after = card(knowledge, seen("localisation/match/scans_fit_map"), **given)
    assert after.next is not None and after.next.test not in all_sound


def test_an_answer_that_an_older_server_kept_is_shown(knowledge: Knowledge) -> None:
    answer = answer_of(knowledge, seen(sim.NO_SCANS))
    told = answer["explanation"]
    for fault in (f for member in told["broken"]["members"] for f in member["faults"]):
        for name in ("kind", "intermittent", "gone_ns"):
            del fault[name]
    for one in told["because"]:
        for name in ("reason", "gone_ns", "weight"):
            del one[name]
    for name in ("make_safe", "then", "order", "instances", "about"):
        del told["next"][name]
    del told["cleared"]
    found = card_of(answer).held({sim.NO_SCANS: SymptomInterval(NOW, None)})
    assert len(found.causes) == 2 and shown(found)
