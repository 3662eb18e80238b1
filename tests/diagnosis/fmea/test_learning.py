"""Numbers learnt from situations, and how they are written into the text of a person."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import pytest

import amberbox.sim
from amberbox.core.expression import parse
from amberbox.core.yaml_nodes import parse_yaml
from amberbox.diagnosis.fmea.edits import edited
from amberbox.diagnosis.fmea.learning import Proposal, SeenSymptom, Situation, fisher, learn
from amberbox.diagnosis.fmea.loader import read_fmea
from amberbox.diagnosis.fmea.model import Fmea, FmeaReferences, SymptomMeasure
from amberbox.diagnosis.fmea.parser import read

HEAT, NOISE, LOAD, SMELL = (f"motor/{name}/ok" for name in ("heat", "noise", "load", "smell"))
KNOWN = FmeaReferences(
    (HEAT, NOISE, LOAD, SMELL), (HEAT, NOISE, LOAD, SMELL),
    measures={HEAT: SymptomMeasure(parse("motor.temp - 40"))},
)  # fmt: skip
TEXT = """\
# the motor
defaults: {detects: 0.9, leak: 0.01, within_s: 1}
symptoms:
  motor/heat/ok: {edges: [5, 20]}   # degrees
types:
  motor:
    failure_modes:
      worn:   # by dust
        rate: 1.0e-3   # per hour
        symptoms: [motor/heat/ok, {symptom: motor/noise/ok, detects: 0.5}]  # both
      burnt:
        probability: 0.01
        symptoms:
          # a fuse
          - symptom: motor/load/ok   # at once
            within_s: 2
            size: {}
          - motor/heat/ok
"""
TEXT = TEXT.replace("            size: {}\n", "")


def loaded(text: str) -> Fmea:
    fmea, problems = read_fmea(text, KNOWN)
    assert fmea is not None, problems
    return fmea


def taught(
    situations: Sequence[Situation], text: str = TEXT, hours: float = 0.0, weight: float = 10
) -> tuple[list[Proposal], str]:
    """Return the proposals, and the text with them; it must be a right one."""
    root = parse_yaml(text, "fmea.yaml", [])
    assert root is not None
    found = learn(read(root, KNOWN, []), loaded(text), situations, hours, KNOWN, weight)
    new, by_hand = edited(text, root, found)
    assert not by_hand
    loaded(new)
    return found, new


def repair(*faults: str, length_s: float = 100, **seen: bool | float) -> Situation:
    """Return a situation; a number is the size of a symptom that was there."""
    known = {
        f"motor/{name}/ok": SeenSymptom(bool(of)) if isinstance(of, bool) else SeenSymptom(True, of)
        for name, of in seen.items()
    }
    return Situation(frozenset(f"motor#{fault}" for fault in faults), length_s, known, "m1")


def values(found: Sequence[Proposal]) -> dict[tuple[str, str, str], str]:
    return {(one.kind, one.mode, one.symptom): one.value for one in found}


def test_a_repair_moves_a_number_by_its_weight_only() -> None:
    found, new = taught([repair("worn", heat=True, noise=True)])
    assert values(found) == {("detects", "motor#worn", NOISE): "0.545"}  # 0.9 hardly moves
    assert "[motor/heat/ok, {symptom: motor/noise/ok, detects: 0.545}]  # both" in new
    assert len(new.splitlines()) == len(TEXT.splitlines())
    many, _ = taught([repair("worn", heat=True, noise=False)] * 1000)
    assert float(values(many)["detects", "motor#worn", NOISE]) == pytest.approx(0.00495, abs=1e-4)
    ever, _ = taught([repair("worn", heat=True, noise=False)] * 100_000)
    assert float(values(ever)["detects", "motor#worn", NOISE]) == 0.001


def test_the_layout_of_a_block_is_kept() -> None:
    _, new = taught([repair("burnt", heat=False, load=False)] * 5)
    assert new.replace("0.6", "0.9") != TEXT
    assert "          - detects: 0.6\n            symptom: motor/load/ok   # at once\n" in new
    assert "          - {symptom: motor/heat/ok, detects: 0.6}\n" in new
    assert new.startswith("# the motor\n") and "# a fuse\n" in new


def test_what_another_fault_explains_or_came_too_early_does_not_count() -> None:
    both = repair("worn", "burnt", heat=False, noise=False, load=False)
    found, _ = taught([both] * 3)
    assert {key[2] for key in values(found) if key[0] == "detects"} == {NOISE, LOAD}
    short, _ = taught([repair("burnt", length_s=1.5, heat=False, load=False)])
    assert {key[2] for key in values(short)} == {HEAT}  # the load may take 2 s
    unknown, _ = taught([repair("worn")] * 3)
    assert not unknown


def test_rates_follow_from_failures_and_hours() -> None:
    found, new = taught([repair("worn")] * 3, hours=1000)
    assert values(found) == {("rate", "motor#worn", ""): "0.0023"}  # 3.5 in 500 h + 1000 h
    assert "        rate: 0.0023   # per hour\n" in new
    assert not taught([], hours=10)[0]  # too short to say anything
    assert not taught([repair("worn")], hours=10)[0]  # one failure is no reason
    fewer, _ = taught([], hours=5000)
    assert values(fewer) == {("rate", "motor#worn", ""): "9.1e-05"}


def test_sizes_need_five_and_are_as_wide_as_they_were() -> None:
    sizes = (21.0, 24.0, 26.0, 29.0, 30.0)
    few, _ = taught([repair("worn", heat=size) for size in sizes[:4]])
    assert {one.kind for one in few} == {"detects"}
    found, new = taught([repair("worn", heat=size) for size in sizes])
    assert values(found)["size", "motor#worn", HEAT] == "{normal: [26, 4.02]}"
    assert "{symptom: motor/heat/ok, detects: 0.933, size: {normal: [26, 4.02]}}" in new
    text = TEXT.replace("[motor/heat/ok,", "[{symptom: motor/heat/ok, size: {uniform: [0, 4]}},")
    found, new = taught([repair("worn", heat=size) for size in sizes], text)
    assert values(found)["size", "motor#worn", HEAT] == "{uniform: [18.8, 32.2]}"
    assert "size: {uniform: [18.8, 32.2]}" in new
    same, _ = taught([repair("worn", heat=1.0 + n / 10) for n in range(5)], text)
    assert ("size", "motor#worn", HEAT) not in values(same)  # the same bin


def test_a_new_symptom_has_to_come_more_often_than_without_the_mode() -> None:
    with_it, without = repair("worn", smell=True), repair(smell=False)
    found, new = taught([with_it] * 4 + [without] * 20)
    assert values(found) == {
        ("symptom", "motor#worn", SMELL): "{symptom: motor/smell/ok, detects: 0.83}"
    }
    assert "detects: 0.5}, {symptom: motor/smell/ok, detects: 0.83}]  # both" in new
    assert not taught([with_it] * 2 + [without] * 20)[0]
    often = [repair(smell=True)] * 15 + [without] * 5
    assert not [one for one in taught([with_it] * 4 + often)[0] if one.kind == "symptom"]
    block = [repair("burnt", smell=True)] * 4 + [without] * 20
    assert "          - {symptom: motor/smell/ok, detects: 0.83}\n" in taught(block)[1]


def test_false_alarms_move_the_leak() -> None:
    seen = [repair(heat=True)] * 3 + [repair(heat=False, noise=True)] * 17
    found, new = taught(seen)
    assert values(found) == {("leak", "", HEAT): "0.05", ("leak", "", NOISE): "0.26"}
    assert "  motor/heat/ok: {edges: [5, 20], leak: 0.05}   # degrees\n" in new
    assert "  motor/noise/ok: {leak: 0.26}\n" in new
    assert taught([repair(heat=True)])[0] == []  # one is no reason
    bare = TEXT.replace("symptoms:\n  motor/heat/ok: {edges: [5, 20]}   # degrees\n", "")
    assert taught(seen, bare)[1].endswith("symptoms:\n  motor/heat/ok: {leak: 0.05}\n"
                                          "  motor/noise/ok: {leak: 0.26}\n")  # fmt: skip


def test_a_parameter_and_an_unobservable_mode_are_left_to_the_person() -> None:
    text = TEXT.replace("detects: 0.5}", "detects: <how>}").replace(
        "types:", "instances: {motor: {motor: {how: 0.5}}}\ntypes:"
    )
    root = parse_yaml(text, "fmea.yaml", [])
    assert root is not None
    situations = [repair("worn", heat=True, noise=True)] * 5
    found = learn(read(root, KNOWN, []), loaded(text), situations, 0.0, KNOWN)
    new, by_hand = edited(text, root, found)
    assert [one.symptom for one in by_hand] == [NOISE] and new.count("<how>") == 1


def test_windows_line_ends_stay() -> None:
    _, new = taught([repair("burnt", heat=False, load=False)] * 5, TEXT.replace("\n", "\r\n"))
    assert new.count("\r\n") == new.count("\n") == TEXT.count("\n") + 1


def test_fisher_is_that_of_the_lady_tasting_tea() -> None:
    assert fisher(4, 4, 0, 4) == pytest.approx(1 / 70)
    assert fisher(3, 4, 1, 4) == pytest.approx(17 / 70)
    assert fisher(0, 4, 4, 4) == 1


def test_a_large_file_of_a_person_changes_in_its_numbers_only() -> None:
    """Each symptom of the simulated robot's modes is not there in one repair."""
    text = (Path(amberbox.sim.__file__).parent / "folder" / "fmea.yaml").read_text(encoding="utf-8")
    before, _ = read_fmea(text)
    root = parse_yaml(text, "fmea.yaml", [])
    assert before is not None and root is not None
    situations = [
        Situation(
            frozenset({mode.id}), 1e6, {link.symptom: SeenSymptom(False) for link in mode.symptoms}
        )
        for mode in before.modes.values()
    ]
    found = learn(read(root, None, []), before, situations, 10.0)
    new, by_hand = edited(text, root, found)
    after, problems = read_fmea(new)
    assert after is not None, problems
    lowered = sum(one.kind == "detects" for one in found) - len(by_hand)
    assert lowered > 200
    for name, mode in before.modes.items():
        pairs = zip(mode.symptoms, after.modes[name].symptoms, strict=True)
        assert all(replace(new, detects=old.detects) == old for old, new in pairs)
        same = replace(after.modes[name], symptoms=mode.symptoms, rate=mode.rate)
        assert replace(same, ranks=mode.ranks, line=0) == replace(mode, line=0)
    assert after.symptoms == before.symptoms and after.functions == before.functions
    assert [line for line in new.splitlines() if line.strip().startswith("#")] == [
        line for line in text.splitlines() if line.strip().startswith("#")
    ]
