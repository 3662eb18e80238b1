"""The proofs that a miss could not be avoided, on planted cases whose verdict is known."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, replace
from pathlib import Path

import pytest

from amberbox.sim.faults import SimulatedFault, catalogue
from benchmarks import ceiling
from benchmarks.accuracy import Outcome, with_figures
from benchmarks.ceiling import (
    MAGNITUDES,
    MARKS,
    Change,
    Evidence,
    Observer,
    Proof,
    alike_twins,
    ceiling_table,
    difference,
    main,
    misses,
    observe,
    prove,
    silent_twins,
)
from benchmarks.missions import Mission, Planted
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


def shown(at_s: float, state: str = "present", level: int | None = None) -> Change:
    return Change(at_s, at_s, state, level, 1.0, ())


def observer(fmea: Mapping[str, Sequence[str]], delay_s: Mapping[str, float]) -> Observer:
    """Return monitors that show the symptoms of each mode, some of them later, piece by piece."""

    def watch(of: Mission) -> Iterator[tuple[float, Evidence]]:
        for until_s in (60.0, END_S):
            found: Evidence = {}
            for planted in of.faults:
                for symptom in fmea[planted.fault.id]:
                    at_s = planted.at_s + delay_s.get(planted.fault.id, 1.0)
                    if at_s <= until_s and symptom not in found:
                        found[symptom] = [shown(at_s)]
            yield until_s, found

    return watch


def proven(
    names: Sequence[str], *group: Sequence[str], kind: str = "single", **delay_s: float
) -> Proof:
    """Examine a mission with these modes that was answered with a group."""
    at = mission(*names)
    faults = {name: fault(name) for name in FMEA}
    twins = [*silent_twins(at), *alike_twins(at, group, faults)]
    return prove(Outcome(kind, 7, [], list(names)), at, twins, observer(FMEA, delay_s))


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
    assert proof.nearest.endswith("laser/process: present at 31.0 s, with the twin no change")
    assert proven(["weak"], ["blocked"]).verdict == "left"
    late = proven(["blocked"], ["dirty"], dirty=2.5)
    assert late.verdict == "left" and "with the twin present at 32.5 s" in late.nearest
    last = proven(["blocked"], ["dirty"], dirty=1.0, blocked=END_S - 30.0)
    assert last.verdict == "left"  # what the last second shows counts, too


def test_answers_that_cannot_be_made_have_no_twin() -> None:
    faults = {name: fault(name) for name in FMEA}
    for answer in (["unknown#other"], ["weak", "base#no_such_mode"], ["blocked"], []):
        assert not list(alike_twins(mission("blocked", "weak"), [answer], faults))


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
        ([shown(30.9, level=3), shown(50.0, "absent")], True),
        ([shown(31.1, level=3), shown(50.0, "absent")], False),
        ([shown(30.0, level=4), shown(50.0, "absent")], False),
        ([shown(30.0, level=3)._replace(blocked_by=("base",)), shown(50.0, "absent")], False),
        ([shown(30.0, level=3)._replace(onset_s=20.0), shown(50.0, "absent")], False),
        ([shown(30.0, level=3)._replace(strength=0.5), shown(50.0, "absent")], False),
        ([shown(30.0, level=3), shown(50.0, "unknown")], False),
        ([shown(30.0, level=3)], False),
        ([], False),
    ],
)
def test_what_counts_as_the_same(other: list[Change], is_same: bool) -> None:
    said = {"a/b": [shown(30.0, level=3), shown(50.0, "absent")]}
    assert (difference(said, {"a/b": other}, END_S) is None) == is_same
    assert (difference({"a/b": other}, said, END_S) is None) == is_same


def test_what_may_still_come_is_no_difference_yet() -> None:
    said = {"a/b": [shown(59.5)]}
    assert difference(said, {}, 60.0) is None
    found = difference(said, {}, 61.0)
    assert found is not None and found[0] == 59.5


def test_the_monitors_of_the_simulated_robot() -> None:
    """A memory leak that is too slow shows nothing, a crash shows itself, or the same by a copy."""

    def at(name: str) -> Mission:
        planted = Planted(catalogue()[name], catalogue()[name].magnitude.low, 8.0)
        return Mission(7, "transport", False, (planted,), 16.0)

    of = Outcome("single", 7, [], [])
    leak = at("navigation_memory_leak")
    assert prove(of, leak, silent_twins(leak)).verdict == "shows nothing"
    crash = at("localisation_crash")
    left = prove(of, crash, silent_twins(crash))
    assert left.verdict == "left" and "localisation" in left.nearest
    copy = replace(catalogue()["localisation_crash"], id="copy")
    twins = [*silent_twins(crash), *alike_twins(crash, [["x#copy"]], {"x#copy": copy})]
    assert prove(of, crash, twins, observe).verdict == "looks like another"


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
    row, *_, last = ceiling_table(found, proofs).splitlines()[2:]
    assert row == "| one fault | 3 | 1 | 1 | 1 | 4 of 5 | 4 | 1 | 2 | 1 | 2 of 5 |"
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
    assert "| one fault | 1 | 1 | 0 | 0 | 0 of 1 |" in page.read_text()
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
