"""Run the detectors of a model over the rows of a record, as far as they are complete.

Detectors see log times. What comes out depends on the rows alone, not on the batches that they come
in: rows are taken in order of time, and time passes in seconds of the record.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from operator import itemgetter
from typing import Any

from amberbox.core.clock import NS
from amberbox.core.contracts import Row
from amberbox.core.errors import AmberboxError
from amberbox.core.types import Batch
from amberbox.detection.alarms import COMBINED, DetectorAlarm
from amberbox.detection.fusion import Fusion
from amberbox.detection.learnt_detector import SILENCE_NS
from amberbox.detection.missions import rows_of_batch
from amberbox.detection.model_file import DetectionModel

PERIOD_NS = NS
_SILENT_NS = 2 * SILENCE_NS  # nothing changes any more when no row came for so long


@dataclass(frozen=True, slots=True)
class DetectorScore:
    """The worst score of a detector in a second of the record, above 1 if it is an alarm."""

    detector: str
    at_ns: int
    score: float
    series: str
    alarms: int
    """How many alarms last."""
    items: Mapping[str, float] = field(default_factory=dict)
    """Of all detectors combined: the score of each item that was learnt, 0 without an alarm."""


Detected = DetectorAlarm | DetectorScore
_Placed = tuple[tuple[int, str, int], Row]


class RecordDetection:
    """The detectors of a model on one record: rows in, scores and changes of alarms out."""

    def __init__(self, model: DetectionModel) -> None:
        self._detectors = model.detectors
        self._fusion = Fusion(len(model.detectors))
        self._items = sorted(learnt_items(model, ()))
        self._waiting: list[_Placed] = []
        self._next_ns = 0
        self._last_ns = 0
        self.until_ns = 0
        """Log time up to which all rows are taken."""

    def begin(self, at_ns: int) -> list[DetectorAlarm]:
        """Begin a run of the recorder, or another axis of time; return the alarms that end."""
        self._waiting = []
        self._last_ns = at_ns
        self._next_ns = (at_ns // PERIOD_NS + 1) * PERIOD_NS
        self.until_ns = at_ns - 1
        ended = [a for detector in self._detectors.values() for a in detector.begin(at_ns)]
        return ended + self._fusion.begin(at_ns)

    def take(self, batches: Iterable[Batch], until_ns: int) -> Iterator[Detected]:
        """Take rows; all those up to ``until_ns`` are in these or earlier batches.

        Rows that were taken before are left out.
        """
        for batch in batches:
            places = zip(batch.log_time_ns.tolist(), batch.seq.tolist(), strict=True)
            self._waiting += [
                ((at_ns, batch.writer, seq), row)
                for (at_ns, seq), row in zip(places, rows_of_batch(batch), strict=True)
                if at_ns > self.until_ns
            ]
        self._waiting.sort(key=itemgetter(0))
        due = [row for _, row in self._waiting if row.at_ns <= until_ns]
        del self._waiting[: len(due)]
        yield from self.take_rows(due, until_ns)

    def take_rows(self, rows: Iterable[Row], until_ns: int) -> Iterator[Detected]:
        """Take rows in the order of arrival: all those after the earlier ones, up to a log time."""
        for row in rows:
            yield from self._pass_time(row.at_ns)
            self._last_ns = row.at_ns
            changed = [a for one in self._detectors.values() for a in one.update((row,))]
            if changed:
                yield from changed
                yield from self._fusion.take(self._alarms(), row.at_ns)
        yield from self._pass_time(until_ns)
        self.until_ns = max(self.until_ns, until_ns)

    def _pass_time(self, at_ns: int) -> Iterator[Detected]:
        """Pass the seconds up to a time that rows before it have been taken."""
        while self._next_ns <= at_ns:
            if self._next_ns > self._last_ns + _SILENT_NS:
                self._next_ns = (at_ns // PERIOD_NS + 1) * PERIOD_NS
                return
            now_ns, self._next_ns = self._next_ns, self._next_ns + PERIOD_NS
            has_scores = False
            for name, detector in self._detectors.items():
                yield from detector.tick(now_ns)
                worst = detector.take_worst()
                if worst is not None:
                    has_scores = True
                    score, series = worst
                    yield DetectorScore(name, now_ns, score, series, len(detector.open_alarms))
            yield from self._fusion.take(self._alarms(), now_ns)
            if has_scores:
                yield self._combined(now_ns)

    def _combined(self, now_ns: int) -> DetectorScore:
        scores = dict.fromkeys(self._items, 0.0)
        lasting = self._fusion.open_alarms
        for alarm in lasting:
            name = alarm.reason.item
            scores[name] = max(scores.get(name, 0.0), round(alarm.score, 3))
        worst = max(scores, key=scores.__getitem__, default="")
        return DetectorScore(
            COMBINED, now_ns, scores.get(worst, 0.0), worst, len(lasting), items=scores
        )

    def open_alarms(self) -> list[DetectorAlarm]:
        """Return the alarms that last, those of all detectors together included."""
        return [*self._alarms(), *self._fusion.open_alarms]

    def _alarms(self) -> list[DetectorAlarm]:
        return [alarm for one in self._detectors.values() for alarm in one.open_alarms]

    def snapshot(self) -> dict[str, Any]:
        """Return the state up to ``until_ns`` as JSON; later rows have to be given again."""
        return {
            "until_ns": self.until_ns,
            "last_ns": self._last_ns,
            "next_ns": self._next_ns,
            "detectors": {name: one.snapshot() for name, one in self._detectors.items()},
            "combined": self._fusion.snapshot(),
        }

    def resume(self, snapshot: Mapping[str, Any]) -> None:
        """Continue from a snapshot; raises AmberboxError if it is none of these detectors."""
        try:
            self.until_ns, self._last_ns, self._next_ns = (
                int(snapshot[name]) for name in ("until_ns", "last_ns", "next_ns")
            )
            states = {name: snapshot["detectors"][name] for name in self._detectors}
            self._fusion.resume(snapshot.get("combined", ()))
        except (KeyError, TypeError, ValueError, OverflowError) as error:
            raise AmberboxError(f"the checkpoint is damaged: {error!r}") from None
        self._waiting = []
        for name, state in states.items():
            self._detectors[name].resume(state)


def learnt_items(model: DetectionModel, known: Sequence[str]) -> frozenset[str]:
    """Return the items that a model has learnt; those ``known`` for files that do not state it."""
    stated = model.origin.get("items")
    if not isinstance(stated, list):
        return frozenset(known)
    return frozenset(name for name in stated if isinstance(name, str))
