"""The proofs that a miss could not be avoided, on planted cases whose verdict is known."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, replace
from pathlib import Path

import pytest
from hypothesis import event, given, settings
from hypothesis import strategies as st

from amberbox.core.types import Diagnosis
from amberbox.diagnosis.diagnose import DiagnosisId, answer
from amberbox.sim.faults import SimulatedFault, catalogue
from benchmarks import ceiling
from benchmarks.accuracy import Outcome, with_figures
from benchmarks.ceiling import (
    MAGNITUDES,
    MARKS,
    Evidence,
    Observer,
    Proof,
    Shown,
    Timing,
    WitnessedTracker,
    alike_twins,
    ceiling_table,
    difference,
    main,
    misses,
    observe,
    prove,
    silent_twins,
)
from benchmarks.diagnosis import world
from benchmarks.missions import Mission, Planted
from tests.diagnosis.tracker.robot import T0_NS, At, knowledge, run
from tools.findings import ROOT

END_S = 120.0
FMEA = {
    "weak": ["wifi/signal"],
    "dirty": ["laser/range"],
    "blocked": ["laser/range"],
    "crash": ["laser/range", "laser/process"],
    "biased": [],
}
"""A small FMEA: which symptoms each mode shows; nothing tells two of them apart, one shows none."""


def fault(name: str) -> SimulatedFault:
    return replace(catalogue()["laser_front_lens_dirty"], id=name)


def mission(*names: str) -> Mission:
    planted = (Planted(fault(name), 0.5, 30.0 + 10 * n) for n, name in enumerate(names))
    return Mission(7, "transport", False, tuple(planted), END_S)


def shown(onset_s: float, level: int | None = None) -> Shown:
    return Shown(onset_s, level, 1.0)


def observer(fmea: Mapping[str, Sequence[str]], delay_s: Mapping[str, float]) -> Observer:
    """Return monitors that show the symptoms of each mode, some of them later, piece by piece."""

    def watch(of: Mission) -> Iterator[tuple[float, Evidence]]:
        for until_s in (60.0, END_S):
            found = Evidence()
            for planted in of.faults:
                for symptom in fmea[planted.fault.id]:
                    at_s = planted.at_s + delay_s.get(planted.fault.id, 1.0)
                    if at_s <= until_s:
                        found.shown.setdefault(symptom, shown(at_s))
            yield until_s, found

    return watch


def proven(
    names: Sequence[str], *group: Sequence[str], kind: str = "single", **delay_s: float
) -> Proof:
    """Examine a mission with these modes that was answered with a group."""
    at = mission(*names)
    faults = {name: fault(name) for name in FMEA}
    twins = [*silent_twins(at), *alike_twins(at, group, faults)]
    of = Outcome(kind, 7, [], list(names))
    return prove(of, at, twins, observer(FMEA, delay_s), Timing(frozenset({"laser/range"})))


def test_a_fault_that_shows_nothing_is_proven() -> None:
    assert proven(["biased"]).verdict == "shows nothing"
    both = proven(["weak", "biased"], ["weak"], kind="double")
    assert (both.verdict, both.twin) == ("shows nothing", "no biased")


def test_modes_with_the_same_symptoms_are_proven() -> None:
    proof = proven(["blocked"], ["dirty"])
    assert proof.verdict == "looks like another" and proof.twin.startswith("dirty=")
    both = proven(["weak", "blocked"], ["dirty", "weak"], kind="double")
    assert both.verdict == "looks like another" and "weak=0.5@30.0s" in both.twin


def test_what_can_be_told_apart_is_left_with_the_first_difference() -> None:
    proof = proven(["crash"], ["blocked"])
    assert proof.verdict == "left" and not proof.twin
    assert proof.nearest.startswith("blocked=")
    assert proof.nearest.endswith("laser/process: present since 31.0 s, with the twin not present")
    assert proven(["weak"], ["blocked"]).verdict == "left"
    late = proven(["blocked"], ["dirty"], dirty=2.5)
    assert late.verdict == "left" and "with the twin present since 32.5 s" in late.nearest
    last = proven(["blocked"], ["dirty"], dirty=1.0, blocked=END_S - 30.0)
    assert last.verdict == "left"  # what the last second shows counts, too


def test_answers_that_cannot_be_made_have_no_twin() -> None:
    faults = {name: fault(name) for name in FMEA}
    for group in (["unknown#other"], ["weak", "base#no_such_mode"], ["blocked"], []):
        assert not list(alike_twins(mission("blocked", "weak"), [group], faults))


def test_magnitudes_and_onsets_of_twins() -> None:
    faults = {name: fault(name) for name in FMEA}
    twins = [each.mission for each in alike_twins(mission("weak", "biased"),
                                                  [["weak", "dirty"]], faults)]  # fmt: skip
    low, high = fault("dirty").magnitude.low, fault("dirty").magnitude.high
    sizes = sorted(each.magnitude for twin in twins for each in twin.faults[1:])
    assert len(sizes) == MAGNITUDES
    assert (sizes[0], sizes[-1]) == pytest.approx((low, high))
    assert {each.at_s for twin in twins for each in twin.faults[1:]} == {40.0}
    swapped = alike_twins(mission("weak", "biased"), [["dirty", "crash"]], faults)
    assert len(list(swapped)) == 2 * MAGNITUDES**2


@pytest.mark.parametrize(
    ("other", "is_same"),
    [
        (Evidence({"a/b": shown(30.9, 3)}, {"c/d": ("absent", 1.0)}), True),
        (Evidence({"a/b": shown(31.1, 3)}, {"c/d": ("absent", 1.0)}), False),
        (Evidence({"a/b": shown(30.0, 4)}, {"c/d": ("absent", 1.0)}), False),
        (Evidence({"a/b": Shown(30.0, 3, 0.5)}, {"c/d": ("absent", 1.0)}), False),
        (Evidence({"a/b": shown(30.0, 3)}, {"c/d": ("absent", 0.5)}), False),
        (Evidence({"a/b": shown(30.0, 3)}), False),
        (Evidence({}, {"c/d": ("absent", 1.0)}), False),
    ],
)
def test_what_counts_as_the_same(other: Evidence, is_same: bool) -> None:
    said = Evidence({"a/b": shown(30.0, 3)}, {"c/d": ("absent", 1.0)})
    timing = Timing(frozenset({"a/b"}))
    assert (difference(said, other, END_S, timing) is None) == is_same
    assert (difference(other, said, END_S, timing) is None) == is_same


def test_an_onset_that_no_cause_times_says_only_what_began_together() -> None:
    said = Evidence({"a/b": shown(30.0)})
    assert difference(said, Evidence({"a/b": shown(39.0)}), END_S) is None
    assert difference(said, Evidence({"a/b": shown(41.0)}), END_S) is not None


def test_another_answer_to_the_same_evidence_is_no_proof() -> None:
    """The tracker keeps an answer whose symptoms only fade: what was before may speak for it."""
    one, other = Evidence(answer=("x#a",)), Evidence(answer=("x#b",))
    found = difference(one, other, END_S)
    assert found == (END_S, "the same evidence, but the answer is x#a, with the twin x#b")


SMALL = knowledge("""\
defaults: {detects: 0.9, leak: 0.001, within_s: 5, hold_s: 3}
symptoms:
  laser/process/running: {by_itself: true}
types:
  laser:
    failure_modes:
      dead: {probability: 0.01, symptoms: [laser/heartbeat/alive, laser/process/running]}
      dirty: {probability: 0.02, takes_down: false, symptoms: [laser/scan/clear]}
  motor:
    failure_modes:
      stuck: {probability: 0.01, symptoms: [motor/encoder/turns, base/drive/follows]}
      weak: {probability: 0.02, takes_down: false, symptoms: [base/drive/follows]}
other: {probability: 1.0e-4}
""")
NAMES = [*SMALL.fmea.symptoms, "hall/door/shut"]
HEARD_S = 30.0


def told(happens: Sequence[At]) -> tuple[Evidence, Diagnosis]:
    """Return the evidence of what monitors found, and what the engine says of it at the end."""
    tracker = WitnessedTracker(SMALL)
    tracker.begin(T0_NS)
    run(tracker, happens, HEARD_S)
    made = answer(SMALL, tracker.situation(), DiagnosisId("x", 1, 0))
    return replace(tracker.evidence(), answer=()), made


happenings = st.builds(
    At,
    st.integers(1, 40).map(lambda half: half / 2),
    st.sampled_from(NAMES),
    st.sampled_from(["present", "present", "absent", "unknown"]),
    st.sampled_from([(), (), ("bus",)]),
)
noise = st.builds(
    At,
    st.integers(1, 40).map(lambda half: half / 2),
    st.sampled_from([name for name in NAMES if name != "laser/process/running"]),
    st.sampled_from(["present", "absent"]),
    st.just(("bus",)),
)


@given(st.lists(happenings, max_size=8), st.lists(noise, max_size=4), st.integers(0, 4))
@settings(deadline=None, max_examples=50)
def test_a_twin_with_the_same_evidence_has_the_same_ranking(
    happens: list[At], more: list[At], later: int
) -> None:
    mine, made = told(happens)
    shifted = [replace(each, at_s=each.at_s + later / 2) for each in happens]
    for other in (shifted, [*happens, *more], [*shifted, *more], happens[1:]):
        evidence, same = told(other)
        if difference(mine, evidence, HEARD_S) is None:
            event("the same")
            assert [(each.id, each.probability) for each in same.hypotheses] == [
                (each.id, each.probability) for each in made.hypotheses
            ]
        else:
            event("another")


def test_what_is_blocked_is_evidence_only_where_the_tracker_uses_it() -> None:
    seen = At(2, "motor/encoder/turns")
    mine, _ = told([seen])
    assert mine.shown["motor/encoder/turns"].level is None
    for name in ("laser/scan/clear", "laser/heartbeat/alive", "hall/door/shut"):
        for state in ("present", "absent"):
            twin, _ = told([seen, At(3, name, state, ("bus",))])
            assert difference(mine, twin, HEARD_S) is None, (name, state)
    for twin, _ in (
        told([seen, At(3, "laser/process/running", "present", ("bus",))]),
        told([seen, At(3, "laser/process/running", "absent", ("bus",))]),
        told([seen, At(3, "laser/scan/clear")]),
        told([seen, At(3, "base/drive/follows", "absent")]),
    ):
        assert difference(mine, twin, HEARD_S) is not None
    again, _ = told([seen, At(3, "motor/encoder/turns", "unknown"), At(4, "motor/encoder/turns")])
    assert difference(mine, again, HEARD_S) is None, "that it is said again is no news"


def test_the_monitors_of_the_simulated_robot() -> None:
    """A memory leak that is too slow shows nothing, a crash shows itself, or the same by a copy."""

    def at(name: str) -> Mission:
        planted = Planted(catalogue()[name], catalogue()[name].magnitude.low, 8.0)
        return Mission(7, "transport", False, (planted,), 16.0)

    of = Outcome("single", 7, [], [])
    timing = Timing.of(world().knowledge)
    leak = at("navigation_memory_leak")
    assert prove(of, leak, silent_twins(leak), timing=timing).verdict == "shows nothing"
    crash = at("localisation_crash")
    left = prove(of, crash, silent_twins(crash), timing=timing)
    assert left.verdict == "left" and "localisation" in left.nearest
    copy = replace(catalogue()["localisation_crash"], id="copy")
    twins = [*silent_twins(crash), *alike_twins(crash, [["x#copy"]], {"x#copy": copy})]
    assert prove(of, crash, twins, timing=timing).verdict == "looks like another"
    (*_, (_, found)) = observe(crash)
    assert found.answer == ("localisation#crash",)
    assert timing.timed and timing.together_s == ceiling.Timing.together_s


def test_the_table_counts_both_ceilings() -> None:
    found = [
        Outcome("single", 1, ["a"], ["x"]),
        Outcome("single", 2, ["b"], ["x"], group=[["y"]]),
        Outcome("single", 3, ["c"], ["x"], group=[["y"], ["x"]]),
        Outcome("single", 4, ["d"], ["x"], group=[["x"]]),
        Outcome("single", 5, ["e"], ["x"], group=[["y"]]),
        Outcome("nominal", 6, [], []),
    ]
    assert [each.seed for each in misses(found, ["single"])] == [1, 2, 5, 3]
    proofs = [
        Proof("single", 1, ["a"], "shows nothing", "nothing"),
        Proof("single", 2, ["b"], "looks like another", "y=1"),
        Proof("single", 3, ["c"], "looks like another", "y=1"),
        Proof("single", 5, ["e"], differences={"y=1": "s: present"}),
    ]
    row, leading, *_, last = ceiling_table(found, proofs).splitlines()[2:]
    cells = "95 % | 2 of 5, 40 % | 4 of 5, 80 % | 3 | 1 | 1 | 1"
    assert row == f"| one fault, first group | {cells} |"
    cells = "90 % | 1 of 5, 20 % | 2 of 5, 40 % | 4 | 1 | 2 | 1"
    assert leading == f"| one fault, first member | {cells} |"
    assert last == "4 of 4 misses were examined; the others count as left."
    assert "3 of 4" in ceiling_table(found, proofs[1:])


def test_proofs_are_kept(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    outcomes, proofs, page = (tmp_path / name for name in ("outcomes", "proofs", "page.md"))
    outcomes.write_text(json.dumps(asdict(Outcome("single", 7, ["a"], ["x"]))) + "\n")
    proof = Proof("single", 7, ["a"], "shows nothing", "nothing")
    proofs.write_text(json.dumps(asdict(proof)) + "\n" + '{"torn')
    page.write_text("\n".join(MARKS))
    words = [str(outcomes), "--keep", str(proofs), "--print", "--page", str(page)]
    assert main(words) == 0
    assert "| 0 of 1, 0 % | 0 of 1, 0 % | 1 | 1 | 0 | 0 |" in page.read_text()
    assert "| single | 7 | `a` | shows nothing | nothing |" in page.read_text()
    proofs.write_text("{}\n")
    assert main(words) == 2 and "is not of this version" in capsys.readouterr().err


def test_other_seeds_are_a_mistake_of_the_user(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    outcomes = tmp_path / "outcomes"
    outcomes.write_text(json.dumps(asdict(Outcome("single", 400_007, ["a"], ["x"]))) + "\n")
    assert main([str(outcomes), "--keep", str(tmp_path / "proofs"), "--processes", "1"]) == 2
    assert "--first-seed" in capsys.readouterr().err


def test_the_page_has_a_place_for_the_table() -> None:
    text = (ROOT / "docs" / "reference" / "accuracy.md").read_text()
    assert "proof" in with_figures(text, "proof", MARKS)
    assert ceiling.TOLERANCE_S == 1.0  # the page states it
