"""A predictable diagnoser: a bad output is a fault, and one item must be positive."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from types import CodeType
from typing import Any

import numpy as np

from amberbox.core.clock import NS
from amberbox.core.types import (
    AmbiguityGroup,
    Batch,
    Diagnosis,
    FaultFacts,
    Hypothesis,
    Status,
    Symptom,
    SymptomState,
    Test,
)

ITEM = "ros_bulk"
NEGATIVE = "bulk.negative"
QUARTER_NS = NS // 4


def answer(
    faults: Sequence[str], explains: Sequence[str], revision: int = 1, at_ns: int = 0, **more: Any
) -> Diagnosis:
    """Make a diagnosis of one answer; without faults it has healed."""
    first = Hypothesis(" + ".join(faults), frozenset(faults), 0.9, tuple(explains))
    group = AmbiguityGroup((first.id,), 0.9)
    state = "open" if faults else "healed"
    values = {"id": "robot-1", "groups": (group,), "symptoms": tuple(explains), "state": state}
    values["next_tests"] = (Test("look", "question", "Look at the lamp"),)
    return Diagnosis(
        **{"revision": revision, "robot": "robot", "at_ns": at_ns, "config_hash": "hash",
           "hypotheses": (first,), "mass_covered": 1.0, **values, **more}
    )  # fmt: skip


class PlainDiagnoser:
    """Returns after each instant the failed components, when they change."""

    def __init__(self) -> None:
        self.items = frozenset({ITEM})
        self.history_s = 0.5
        self.facts: Mapping[str, FaultFacts] = {}
        self.left_out: Mapping[str, str] = {}
        self.guarded: frozenset[CodeType] = frozenset()
        self.present: dict[str, None] = {}
        self.last: float | None = None
        self.negative = False
        self.number = self.revision = self.until_ns = 0
        self.rows: list[tuple[int, float]] = []

    def begin(self, at_ns: int) -> None:
        """Reset all evidence; an open diagnosis stays open."""
        self.rows, self.last, self.until_ns = [], None, at_ns

    def feed(self, batch: Batch) -> None:
        """Take the rows of the one item."""
        if batch.item == ITEM:
            column = batch.columns["data"]
            assert isinstance(column, np.ndarray)
            times, values = batch.log_time_ns.tolist(), column.tolist()
            self.rows += [row for row in zip(times, values, strict=True) if row[0] > self.until_ns]

    def advance(
        self, found: Sequence[Status | Symptom], until_ns: int
    ) -> list[Symptom | Diagnosis]:
        """Go on instant by instant."""
        own = list(self._condition(until_ns))
        heard = [finding for finding in found if isinstance(finding, Symptom)] + own
        said: list[Symptom | Diagnosis] = []
        for at_ns in sorted({symptom.confirmed_ns or 0 for symptom in heard}):
            before = list(self.present)
            for symptom in (one for one in heard if one.confirmed_ns == at_ns):
                self._take(symptom)
            said += [symptom for symptom in own if symptom.confirmed_ns == at_ns]
            if before != list(self.present):
                said.append(self._diagnosis(at_ns, new=not before))
        self.until_ns = until_ns
        return said

    def _take(self, symptom: Symptom) -> None:
        if symptom.state == "present" and not symptom.blocked_by:
            self.present[symptom.id] = None
        else:
            self.present.pop(symptom.id, None)

    def _condition(self, until_ns: int) -> Iterator[Symptom]:
        first_ns = self.until_ns // QUARTER_NS * QUARTER_NS + QUARTER_NS
        for at_ns in range(first_ns, until_ns + 1, QUARTER_NS):
            passed = [value for time_ns, value in self.rows if time_ns <= at_ns]
            self.rows = self.rows[len(passed) :]
            self.last = passed[-1] if passed else self.last
            bad = self.last is not None and self.last < 0
            if bad != self.negative:
                self.negative = bad
                state: SymptomState = "present" if bad else "absent"
                yield Symptom(NEGATIVE, state, confirmed_ns=at_ns, source="condition")

    def _diagnosis(self, at_ns: int, *, new: bool) -> Diagnosis:
        self.number += new
        self.revision = 1 if new else self.revision + 1
        faults = sorted({f"{name.partition('/')[0]}#broken" for name in self.present})
        return answer(faults, list(self.present), self.revision, at_ns, id=f"robot-{self.number}")

    def snapshot(self) -> dict[str, Any]:
        """Return its state."""
        names = ("last", "until_ns", "negative", "number", "revision")
        return {"present": list(self.present)} | {name: getattr(self, name) for name in names}

    def resume(self, snapshot: Mapping[str, Any]) -> None:
        """Restore its state."""
        self.__dict__.update(snapshot)
        self.present = dict.fromkeys(snapshot["present"])
        self.rows = []
