"""Reading fmea.yaml: types are expanded, names resolved, and all errors reported."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from amberbox.core.needs import NOTHING, all_of, any_of
from amberbox.diagnosis.fmea.loader import load_fmea, read_fmea
from amberbox.diagnosis.fmea.model import ExpectedOutcome, SymptomLink, lost
from tests.diagnosis.fmea.small import KNOWN, TEXT, small


def test_types_are_written_out_with_their_parameters() -> None:
    fmea = small()
    assert list(fmea.components) == ["laser_front", "laser_rear", "host", "hook"]
    assert fmea.components["laser_rear"].description == "the rear laser"
    assert fmea.modes["laser_front#dead"].description == "the front laser is dead"
    assert fmea.modes["laser_rear#dirty"].symptoms == (
        SymptomLink("laser_rear/window/clear", 0.9, 5, 2),
    )
    assert fmea.modes["laser_rear#dirty"].tests == (
        ExpectedOutcome("laser_rear.look", "dirty", 0.95),
    )
    assert fmea.modes["laser_rear#wet"].tests == (ExpectedOutcome("laser_rear.look", "wet", 0.8),)
    classes = fmea.modes["laser_front#dirty"].classes
    assert classes == ("carlson_murphy.sensor", "steinbauer.environment")


def test_needs_come_from_the_file_else_from_the_component() -> None:
    fmea = small()
    assert fmea.components["laser_front"].needs == all_of("host")
    assert fmea.components["hook"].needs == all_of("host")  # somewhere_else is not in this file
    assert fmea.functions["see"].needs == any_of("laser_front", "laser_rear")


def test_effects_follow_from_needs() -> None:
    effects = small().modes["laser_front#dead"].effects
    assert effects.next == ("see",) and effects.system == ("see", "carry")
    assert small().modes["laser_front#dirty"].effects.system == ()


def test_a_prior_comes_from_rate_and_exposure_or_is_given() -> None:
    fmea = small()
    assert fmea.modes["laser_front#dead"].chance() == pytest.approx(0.00995016625083189)
    assert fmea.modes["laser_front#dead"].chance(10) == pytest.approx(9.995001666e-4)
    assert fmea.modes["hook#bent"].chance(10) == 0.03


def test_ranks_come_from_tables_or_by_hand() -> None:
    ranks = small().modes["laser_front#dead"].ranks
    assert (ranks.severity, ranks.occurrence, ranks.detection, ranks.number) == (8, 5, 3, 120)
    by_hand = small("        rate: 1.0e-4\n", "        rate: 1.0e-4\n        sod: {s: 2, d: 7}\n")
    assert by_hand.modes["laser_front#dead"].ranks.number == 2 * 5 * 7


def test_occurrence_gives_the_rate_by_the_table() -> None:
    fmea = small("        rate: 1.0e-4\n", "        ranks: {o: 5}\n")
    assert fmea.modes["laser_front#dead"].rate == 1e-4


def test_other_spellings_of_keys() -> None:
    text = TEXT.replace("failure_modes:", "modes:").replace("question:", "look:")
    fmea, problems = read_fmea(text, KNOWN)
    assert fmea is not None and not problems
    assert list(fmea.modes) == list(small().modes)
    assert fmea.tests["laser_front.look"].kind == "check"


def test_a_ratio_is_a_share_of_the_components_rate() -> None:
    text = TEXT.replace("    needs: [host]\n", "    needs: [host]\n    rate: 1.0e-3\n")
    fmea, _ = read_fmea(text.replace("        rate: 1.0e-4\n", "        ratio: 0.6\n"), KNOWN)
    assert fmea is not None and fmea.modes["laser_front#dead"].rate == pytest.approx(6e-4)


def test_a_symptom_waits_for_the_slowest_of_its_links() -> None:
    symptom = small().symptoms["laser_front/window/clear"]
    assert (symptom.within_s, symptom.hold_s, symptom.leak) == (60.0, 2.0, 1e-4)


def test_one_condition_is_one_symptom_of_each_component() -> None:
    fmea = small()
    condition = fmea.symptoms["laser_front.hot"].condition
    assert condition is not None and condition.addresses() == ("sim_scan.temperature",)
    assert fmea.modes["laser_front#hot"].symptoms[0].symptom == "laser_front.hot"
    inline = small("symptoms: [hot]", "symptoms: [{when: sim_scan.speed > 3 for 2s}]")
    assert "laser_rear#hot.0" in inline.symptoms


def test_a_symptom_with_no_chance_is_none() -> None:
    fmea = small("detects: 0.4", "detects: 0")
    assert fmea.functions["carry"].symptoms == ()


WRONG = [
    (
        "<component>/window/clear, detects: 0.9",
        "<component>/window/claer, detects: 0.9",
        "window/claer",
        "there is no symptom 'laser_front/window/claer'; did you mean 'laser_front/window/clear'?",
    ),
    (
        "[host/heartbeat/alive]",
        "[host/heartbeat/rate_hz]",
        "[host/heartbeat/rate_hz]",
        "nothing is expected of 'host/heartbeat/rate_hz', so that it is never bad",
    ),
    (
        "probability: 0.03",
        "probability: 1.2",
        "1.2",
        "1.2 is above 1: expected a share from 0 to 1",
    ),
    ("rate: 1.0e-4", "rate: -1", "rate: -1", "-1 lies below 0"),
    ("exposure_h: 100", "remember_s: -5", "remember_s: -5", "-5 lies below 0"),
    ("exposure_h: 100", "other: {looks_like: 2}", "looks_like: 2", "2 is above 1"),
    ("exposure_h: 100", "other: {looks_lik: 0.1}", "looks_lik:", "did you mean 'looks_like'?"),
    ("exposure_h: 100", "other: {together_s: -1}", "together_s: -1", "-1 lies below 0"),
    (
        "any: [laser_front, laser_rear]",
        "any: [laser_front, laser_raer]",
        "raer",
        "there is no component or function 'laser_raer'; did you mean 'laser_rear'?",
    ),
    (
        "any: [laser_front, laser_rear]",
        "any: []",
        "any: []",
        "nothing is named: a gate without input",
    ),
    ("needs: [see, hook]", "needs: [carry, hook]", "[carry, hook]", "needs itself: carry -> carry"),
    (
        "  hook:\n    failure",
        "  hook:\n    needs: [carry]\n    failure",
        "needs: [see, hook]",
        "needs itself",
    ),
    (
        "  laser:\n    laser_front",
        "  lasr:\n    laser_front",
        "lasr:",
        "there is no type 'lasr'; did you mean 'laser'?",
    ),
    (
        "    laser_rear: {side: rear}",
        "    host: {side: rear}",
        "  host:\n    failure",
        "the component 'host' is there already, as laser",
    ),
    ("    laser_rear: {side: rear}", "    Laser 2: {side: rear}", "Laser 2", "'Laser 2' is no id"),
    (
        "the <side> laser is",
        "the <sid> laser is",
        "<sid>",
        "there is no parameter <sid>; did you mean 'side'?",
    ),
    (
        "tests: {look: dirty}",
        "tests: {lok: dirty}",
        "{lok",
        "there is no test 'lok'; did you mean 'look'?",
    ),
    (
        "tests: {look: dirty}",
        "tests: {look: drity}",
        "drity",
        "the test gives no 'drity'; did you mean 'dirty'?",
    ),
    (
        "class: [sensor,",
        "class: [sensr,",
        "sensr",
        "there is no class 'sensr'; did you mean 'sensor'?",
    ),
    ("class: [sensor, ", "class: [interaction, ", "interaction", "'interaction' is ambiguous"),
    (
        "sim_scan.temperature > 60",
        "sim_scan.temperatur > 60",
        "temperatur >",
        "there is no variable or output 'sim_scan.temperatur'",
    ),
    ("sim_scan.temperature > 60", "sim_scan.temperature + 60", "temperature +", "is no condition"),
    (
        "unobservable: it has no sensor",
        "takes_down: false",
        "probability: 0.03",
        "nothing shows it: give symptoms",
    ),
    (
        "unobservable: it has no sensor",
        "unobservable: x, symptoms: [host/heartbeat/alive]",
        "unobservable: x",
        "it has symptoms, so it is not unobservable",
    ),
    ("        rate: 1.0e-4\n", "", "      dead:", "how probable is it?"),
    (
        "        rate: 1.0e-4\n",
        "        rate: 1.0e-4\n        probability: 0.1\n",
        "rate: 1.0e-4",
        "give one of probability and rate",
    ),
    (
        "        rate: 1.0e-4\n",
        "        ratio: 0.1\n",
        "      dead:",
        "it has a ratio, but the type has no rate",
    ),
    (
        "        rate: 1.0e-4\n",
        "        ranks: {o: 4}\n",
        "ranks: {o: 4}",
        "the table scales.occurrence has no rank 4",
    ),
    (
        "severity: critical",
        "severity: high",
        "severity: high",
        "expected one of warning, urgent, critical",
    ),
    (
        "takes_down: false\n        class",
        "takes_dwn: false\n        class",
        "takes_dwn",
        "unknown key 'takes_dwn'; did you mean 'takes_down'?",
    ),
    (
        "  carry:\n    needs",
        "  host:\n    needs",
        "  host:\n    needs: [see",
        "'host' is a component and a function",
    ),
    (
        "  see: {needs: {any: [laser_front, laser_rear]}, ",
        "  see: {",
        "  see: {",
        "the key 'needs' is missing",
    ),
    (
        "outcomes: [clean, dirty, wet]",
        "outcomes: [clean]",
        "outcomes: [clean]",
        "a test has at least two different answers",
    ),
    (
        "occurrence: {1: 1.0e-6",
        "occurrence: {11: 1.0e-6",
        "occurrence: {11",
        "'11' is no rank from 1 to 10",
    ),
    (
        "outcomes: [clean, dirty, wet]",
        "minutes: .inf",
        "minutes: .inf",
        "inf is more than 1,000,000,000",
    ),
]


@pytest.mark.parametrize(("old", "new", "place", "what"), WRONG)
def test_what_is_wrong_is_told_with_its_line(old: str, new: str, place: str, what: str) -> None:
    assert old in TEXT
    text = TEXT.replace(old, new)
    line = text[: text.index(place)].count("\n") + 1
    fmea, problems = read_fmea(text, KNOWN)
    told = [(problem.line, problem.what) for problem in problems if problem.is_error]
    assert fmea is None
    assert any(what in said and at == line for at, said in told), told


def test_one_mistake_is_told_once_and_hides_no_other() -> None:
    text = TEXT.replace("rate: 1.0e-4", "rate: fast").replace("[see, hook]", "[see, hok]")
    text = text.replace("<component>/window/clear, detects: 0.5", "<component>/win/clear")
    fmea, problems = read_fmea(
        text.replace("rate: 2.0e-5", "rate: 2.0e-5\n        cuase: x"), KNOWN
    )
    assert fmea is None
    assert [problem.line for problem in problems] == [21, 26, 34, 46]


def test_without_a_robot_folder_addresses_are_believed() -> None:
    fmea, problems = read_fmea(TEXT.replace("host/heartbeat/alive", "host/no_mode/no_output"))
    assert fmea is not None and not problems
    _, problems = read_fmea(TEXT.replace("[host/heartbeat/alive]", "[hot_host]"))
    assert "there is no symptom 'hot_host'" in problems[0].what


def test_an_effect_that_needs_do_not_bear_out_is_noted() -> None:
    old = "        severity: critical\n"
    _, problems = read_fmea(TEXT.replace(old, f"{old}        effects: {{system: [hook]}}\n"), KNOWN)
    assert [(p.is_error, p.what) for p in problems] == [
        (False, "hook does not need laser_front, directly or not")
    ]
    _, problems = read_fmea(TEXT.replace(old, f"{old}        effects: {{next: [sea]}}\n"), KNOWN)
    assert problems[0].what == "there is no function 'sea'; did you mean 'see'?"


def test_files_that_are_not_there_or_no_yaml(tmp_path: Path) -> None:
    fmea, problems = load_fmea(tmp_path / "fmea.yaml")
    assert fmea is None and "cannot be read" in problems[0].what
    (tmp_path / "fmea.yaml").write_text("types: [", encoding="utf-8")
    fmea, problems = load_fmea(tmp_path / "fmea.yaml")
    assert fmea is None and problems[0].where == "syntax"
    (tmp_path / "fmea.yaml").write_text("", encoding="utf-8")
    fmea, problems = load_fmea(tmp_path / "fmea.yaml")
    assert fmea is not None and not fmea.modes and not problems


@pytest.mark.parametrize(
    ("given", "what"),
    [
        ("90", "90 is above 1: expected a share from 0 to 1; did you mean 0.9?"),
        ("90 %", "expected a number, got text '90 %'; did you mean 0.9?"),
        ("[1]", "expected a number, got a list"),
    ],
)
def test_a_wrong_share_of_a_symptom_is_told_with_its_key(given: str, what: str) -> None:
    text = TEXT.replace("detects: 0.9,", f"detects: {given},")
    fmea, problems = read_fmea(text, KNOWN)
    assert fmea is None
    assert [(p.where, p.what) for p in problems] == [
        ("types.laser.failure_modes.dirty.symptoms[0].detects", what)
    ]
    assert problems[0].line == text[: text.index(f"detects: {given},")].count("\n") + 1


@pytest.mark.parametrize(
    ("old", "new", "where"),
    [
        ("rate: 1.0e-4", "rate: 1000", "types.laser.failure_modes.dead.rate"),
        ("description: the <side> laser\n", "rate: 1000\n", "types.laser.rate"),
    ],
)
def test_a_rate_that_no_part_has_is_noted(old: str, new: str, where: str) -> None:
    fmea, problems = read_fmea(TEXT.replace(old, new), KNOWN)
    assert fmea is not None
    (note,) = problems
    assert (note.where, note.is_error) == (where, False)
    assert note.what == "1000 per hour is one failure every 3.6 s; did you mean 0.001?"


FOLDER = replace(
    KNOWN,
    outputs=(*KNOWN.outputs, "tray/full/ok", "lamp/on/ok"),
    needs={**KNOWN.needs, "tray": all_of("feeder"), "feeder": all_of("host"), "lamp": NOTHING},
    files={"tray": "components/tray.yaml", "lamp": "components/lamp.yaml"},
)


def test_functions_need_components_that_only_the_folder_has() -> None:
    fmea, problems = read_fmea(TEXT.replace("needs: [see, hook]", "needs: [see, tray]"), FOLDER)
    assert fmea is not None
    assert "carry" in lost(fmea, ["host#off"]), "the tray needs the feeder, and that the host"
    assert "lamp" not in fmea.components
    assert [(p.file, p.where, p.what, p.is_error) for p in problems] == [
        ("components/lamp.yaml", "component",
         "'lamp' is monitored, but no failure mode is known: no diagnosis names it", False),
        ("fmea.yaml", "carry.needs",
         "of 'tray' no failure mode is known: it fails only with what it needs", False),
    ]  # fmt: skip


def test_what_is_monitored_for_the_symptoms_of_others_is_not_noted() -> None:
    text = TEXT.replace("[host/heartbeat/alive]", "[host/heartbeat/alive, lamp/on/ok]")
    watched = replace(FOLDER, watched=(*KNOWN.watched, "lamp/on/ok"))
    fmea, problems = read_fmea(text, watched)
    assert fmea is not None
    assert [problem.file for problem in problems] == ["components/tray.yaml"]


def test_without_the_folder_its_components_are_not_known() -> None:
    _, problems = read_fmea(TEXT.replace("needs: [see, hook]", "needs: [see, tray]"))
    assert ("carry.needs", "there is no component or function 'tray'") in [
        (p.where, p.what) for p in problems
    ]


def test_a_circle_in_the_folder_alone_is_no_error() -> None:
    needs = {**FOLDER.needs, "feeder": all_of("tray"), "hook": all_of("tray", "host")}
    text = TEXT.replace("needs: [see, hook]", "needs: [see, hook, tray]")
    fmea, problems = read_fmea(text, replace(FOLDER, needs=needs))
    assert fmea is not None, problems
    assert "hook" in lost(fmea, ["host#off"])
