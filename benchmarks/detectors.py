"""Detectors beside the watcher in ``benchmarks.diagnosis``: learnt on a nominal hour, and followed.

``benchmarks.diagnosis --model learn`` learns a model on an hour of the simulated robot in its five
scenarios, with and without a cart, 60 % of each to fit and 40 % to calibrate; ``--model FILE``
reads one. The detectors are fed the messages that the watcher is fed, and it is told once a second
which of their alarms last, as ``amberbox detect`` does. ``benchmarks.with_detectors`` compares
diagnoses without and with them.
"""

from __future__ import annotations

import os
import tempfile
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from amberbox.agent.detect import finding_values, is_much_rarer
from amberbox.core.clock import NS
from amberbox.core.contracts import Row
from amberbox.core.given_answers import ITEM as EVENTS
from amberbox.core.given_findings import KIND, RecordedFinding, finding_event
from amberbox.core.types import Batch, Column, ItemSchema
from amberbox.detection.alarms import COMBINED, DetectorAlarm
from amberbox.detection.calibration import count_alarms
from amberbox.detection.learn import learn
from amberbox.detection.missions import rows_of_batch
from amberbox.detection.model_file import load_model, save_model
from amberbox.detection.record_detection import RecordDetection
from amberbox.sim.robot import START_NS, Message
from benchmarks.missions import NOMINAL, Batches, Mission, live, seconds_of

VARIABLE = "AMBERBOX_BENCHMARK_MODEL"
"""Environment variable with the model file, for the processes of a pool."""
FIRST_SEED = 40_000
DETECTORS = ("event_timing", "guard", "residual")
HOUR_S = 3600.0
FALSE_ALARMS_PER_HOUR = 1.0
_DELAY_NS = NS // 2
"""How long after a second of the record the watcher has been told of it."""
_STAMP = "header_stamp"


class _AllVariables:
    def __contains__(self, name: object) -> bool:
        return not str(name).startswith(_STAMP)


class _AllItems(dict[str, Any]):
    def __contains__(self, item: object) -> bool:
        return True

    def __missing__(self, item: str) -> _AllVariables:
        return _AllVariables()


def _everything() -> Batches:
    return Batches(_AllItems())


@dataclass(frozen=True)
class NominalMission:
    """A simulated nominal mission, kept as batches."""

    name: str
    span: tuple[int, int]
    chunks: Sequence[Sequence[Batch]] = field(repr=False)

    @classmethod
    def of(cls, mission: Mission) -> NominalMission:
        """Simulate a mission."""
        every = _everything()
        chunks = [list(every.of(messages)) for _, messages in live(mission)]
        end_ns = START_NS + round(mission.seconds * NS)
        return cls(f"{mission.scenario} {mission.seed}", (START_NS, end_ns), chunks)

    def __iter__(self) -> Iterator[Row]:
        for batches in self.chunks:
            rows = [row for batch in batches for row in rows_of_batch(batch)]
            yield from sorted(rows, key=lambda row: row.at_ns)


def nominal_hour(seconds: float = HOUR_S, first_seed: int = FIRST_SEED) -> list[NominalMission]:
    """Simulate an hour: missions to fit on in every scenario, then those to calibrate on."""
    drives = [("transport", True), *((name, False) for name in dict.fromkeys(NOMINAL))]
    parts = [(name, cart, share) for share in (0.6, 0.4) for name, cart in drives]
    return [
        NominalMission.of(
            Mission(first_seed + number, name, cart, (), seconds * share / len(drives))
        )
        for number, (name, cart, share) in enumerate(parts)
    ]


def learn_model(path: Path, seconds: float = HOUR_S) -> None:
    """Learn a model on nominal operation, and write its file."""
    save_model(learn(nominal_hour(seconds), DETECTORS, FALSE_ALARMS_PER_HOUR), path)


def model_path() -> Path | None:
    """Return the model file of this experiment; None without detectors."""
    name = os.environ.get(VARIABLE)
    return Path(name) if name else None


class Following:
    """The detectors of a model on one mission, and what the watcher is told of them."""

    def __init__(self, path: Path) -> None:
        self._detection = RecordDetection(load_model(path))
        self._detection.begin(START_NS)
        self._every = _everything()
        self._until_ns = START_NS
        self._told: dict[str, float] = {}
        self.alarms: list[DetectorAlarm] = []
        """All alarms that have begun."""

    def take(self, messages: Sequence[Message], until_ns: int) -> Iterator[Batch]:
        """Take messages up to a time; yield the findings that the watcher records."""
        batches: Iterable[Batch] = self._every.of(messages)
        told: list[tuple[int, RecordedFinding]] = []
        while self._until_ns < until_ns:
            self._until_ns = min(self._until_ns + NS, until_ns)
            found = self._detection.take(batches, self._until_ns)
            self.alarms += [
                one for one in found if isinstance(one, DetectorAlarm) and one.gone_ns is None
            ]
            batches = ()
            told += ((self._until_ns + _DELAY_NS, given) for given in self._news())
        if told:
            yield _events(told)

    def _news(self) -> Iterator[RecordedFinding]:
        lasting = {alarm.id: alarm for alarm in self._detection.open_alarms()}
        for name in [name for name in self._told if name not in lasting]:
            del self._told[name]
            yield RecordedFinding(name, "absent")
        for name, alarm in lasting.items():
            if name not in self._told or is_much_rarer(alarm, self._told[name]):
                self._told[name] = alarm.leak
                yield msgspec.convert({"id": name, **finding_values(alarm)}, RecordedFinding)

    def found_by(self, from_s: float = 0.0) -> list[str]:
        """Return the detectors that have begun an alarm since a second of the mission."""
        begun = [a for a in self.alarms if seconds_of(a.confirmed_ns) >= from_s]
        return sorted({alarm.detector for alarm in begun} - {COMBINED})

    def false_alarms(self, until_s: float) -> int:
        """Return how many alarms began before a second, those of ten seconds counted as one."""
        return counted(a for a in self.alarms if seconds_of(a.confirmed_ns) < until_s)


def counted(alarms: Iterable[DetectorAlarm]) -> int:
    """Return how many alarms of a mission have begun, those of ten seconds counted as one."""
    return count_alarms({(0, int(seconds_of(alarm.confirmed_ns))) for alarm in alarms})


def follow() -> list[Following]:
    """Return the detectors that follow a mission: one model's, or none."""
    model = model_path()
    return [] if model is None else [Following(model)]


def use(model: str | None) -> None:
    """Use a model file in this experiment and its processes; ``learn`` learns one first."""
    if model is None:
        return
    path = Path(model)
    if model == "learn":
        path = Path(tempfile.mkdtemp()) / "nominal_hour.model"
        learn_model(path)
        print(f"learnt {path}")
    os.environ[VARIABLE] = str(path)


def _events(told: Sequence[tuple[int, RecordedFinding]]) -> Batch:
    at_ns = np.array([at for at, _ in told], np.int64)
    details = [finding_event(given, "watch")["details"] for _, given in told]
    columns = {"kind": np.array([KIND] * len(told), object), "details": np.array(details, object)}
    schema = ItemSchema("event", tuple(Column(name, name, "string") for name in columns))
    places = np.arange(len(told))
    return Batch(EVENTS, schema, "watch", 1, places, at_ns, at_ns, at_ns, columns)
