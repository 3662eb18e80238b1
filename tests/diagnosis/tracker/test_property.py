"""The result does not depend on the division into calls, or on where snapshots are taken."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

from hypothesis import given, settings
from hypothesis import strategies as st

from amberbox.core.clock import NS
from amberbox.core.types import Diagnosis, Symptom, SymptomState
from amberbox.diagnosis.tracker import FaultTracker
from tests.diagnosis.tracker.robot import T0_NS, TEXT, copied, knowledge, rows, status

TICK_NS = NS // 20
END = 400
"""How many ticks a life lasts."""
KNOWLEDGE = knowledge(
    TEXT.replace("hold_s: 2", "hold_s: 1")
    .replace("within_s: 10", "within_s: 3")
    .replace("motor.temperature > 60", "mean(motor.temperature over 1s) > 60 and not hall/lamp/on")
)
NAMES = [*(name for name in KNOWLEDGE.fmea.symptoms if "/" in name), "hall/door/shut"]
STATES: list[SymptomState] = ["present", "present", "absent", "absent", "unknown"]

ticks = st.integers(1, END)
tellings = st.tuples(
    ticks, st.sampled_from(NAMES), st.sampled_from(STATES), st.sampled_from([(), (), ("bus",)])
)
samples = st.tuples(ticks, st.sampled_from([20.0, 90.0]))
lamps = st.tuples(ticks, st.booleans())


@dataclass(frozen=True)
class Life:
    """Findings and measurements by ticks; at ``epoch`` a new epoch begins."""

    told: Sequence[tuple[int, str, SymptomState, tuple[str, ...]]]
    samples: Sequence[tuple[int, float]]
    lamps: Sequence[tuple[int, bool]]
    epoch: int

    def found(self, after: int, until: int) -> list[object]:
        """Return what monitors found in some ticks."""
        lit = [status(tick / 20, "hall", "lamp", on=on)
               for tick, on in self.lamps if after < tick <= until]  # fmt: skip
        told = [
            Symptom(name, state, name, _ns(tick) if state == "present" else None, _ns(tick),
                    blocked_by=blocked_by)
            for tick, name, state, blocked_by in self.told if after < tick <= until
        ]  # fmt: skip
        return [*lit, *told]

    def feed(self, tracker: FaultTracker, after: int, until: int) -> None:
        """Feed the measurements of some ticks."""
        part = [(tick, value) for tick, value in self.samples if after < tick <= until]
        if part:
            tracker.feed(rows("motor", [t / 20 for t, _ in part], temperature=[v for _, v in part]))


lives = st.builds(
    Life,
    st.lists(tellings, max_size=25).map(lambda found: sorted(found, key=lambda one: one[0])),
    st.lists(samples, max_size=40).map(lambda found: sorted(found, key=lambda one: one[0])),
    st.lists(lamps, max_size=12).map(lambda found: sorted(found, key=lambda one: one[0])),
    st.integers(END // 3, END),
)


def _ns(tick: int) -> int:
    return T0_NS + tick * TICK_NS


def _live(life: Life, cuts: Sequence[int], kept: frozenset[int]) -> list[Symptom | Diagnosis]:
    """Live through a life in steps; where it is ``kept``, by way of a snapshot."""
    tracker, after, began = FaultTracker(KNOWLEDGE), 0, 0
    tracker.begin(T0_NS)
    out: list[Symptom | Diagnosis] = []
    for until in sorted({*cuts, life.epoch, END}):
        life.feed(tracker, after, until)
        out += tracker.advance(life.found(after, until), _ns(until))
        after = until
        if until == life.epoch:
            tracker.begin(_ns(until))
            began = until
        if until in kept:
            tracker = copied(tracker)
            since = until - round(tracker.history_s * 20)
            life.feed(tracker, max(since, began), until)
    return out


@settings(max_examples=120)
@given(lives, st.lists(ticks, max_size=12), st.lists(ticks, max_size=12), st.data())
def test_cuts_and_snapshots_change_nothing(
    life: Life, one: list[int], other: list[int], data: st.DataObject
) -> None:
    expected = _live(life, one, frozenset())
    places = sorted({*other, life.epoch})
    kept = frozenset(data.draw(st.lists(st.sampled_from(places), max_size=6)))
    assert _live(life, other, kept) == expected


@settings(max_examples=60)
@given(lives)
def test_one_diagnosis_at_a_time_in_order_of_time(life: Life) -> None:
    out = _live(life, [], frozenset())
    times = [one.at_ns if isinstance(one, Diagnosis) else one.confirmed_ns or 0 for one in out]
    assert times == sorted(times)
    made = [one for one in out if isinstance(one, Diagnosis)]
    for before, after in itertools.pairwise(made):
        if before.state == "healed":
            assert after.revision == 1 and after.id > before.id
        else:
            assert (after.id, after.revision) == (before.id, before.revision + 1)
    assert all(one.at_ns % (NS // 2) == 0 for one in made if one.revision > 1)
