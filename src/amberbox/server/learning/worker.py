"""The worker's part of learning: reads missions of robots, writes a model file."""

from __future__ import annotations

import hashlib
import shutil
from collections.abc import Iterator, Mapping, Sequence
from itertools import chain
from pathlib import Path
from typing import Any

import msgspec

from amberbox.core.contracts import MissionRows, Span
from amberbox.detection.alarms import COMBINED, DetectorAlarm, alarm_to_json
from amberbox.detection.learn import learning, options_of, report_lines
from amberbox.detection.learnt_detector import LearntDetector
from amberbox.detection.missions import (
    NominalRecord,
    RecordRows,
    Window,
    missions_of_all,
    readable_items,
    short_lists,
    team_missions_of,
    team_rows,
)
from amberbox.detection.model_file import DetectionModel, load_model, save_model
from amberbox.detection.record_detection import RecordDetection, learnt_items
from amberbox.server.data.missions import missions
from amberbox.server.data.snapshot import (
    RecordSnapshot,
    SnapshotRecord,
    open_catalogue,
    with_snapshot,
)
from amberbox.server.learning.following import FILE, STEP_NS, FollowState, with_changes
from amberbox.server.learning.models import FOLDER, LearningProgress, LearnRequest
from amberbox.server.live.records import clock_offsets_ns

_MOST_LINES = 100
_MOST_ALARMS = 1000


def learn(folder: Path, arguments: Mapping[str, Any]) -> Iterator[bytes]:
    """Learn a model; yield the progress as JSON, at the end with size, hash and report.

    Remains of an earlier attempt are deleted. Raises UsageError for unknown missions, AmberboxError
    where there is nothing to learn from, or the model would be too large.
    """
    wanted = msgspec.convert(arguments["wanted"], LearnRequest)
    place = folder / FOLDER / arguments["id"]
    shutil.rmtree(place, ignore_errors=True)
    place.mkdir(parents=True, mode=0o700)
    notes: list[str] = []
    within = wanted.from_ns, wanted.to_ns
    records = [_record(folder, robot, within) for robot in wanted.robots]
    found: Sequence[MissionRows]
    if wanted.team:
        ahead_ns = _ahead_ns(folder, wanted.robots)
        found = team_missions_of(records, wanted.missions, within, ahead_ns)
    else:
        found = missions_of_all(records, wanted.missions, within, notes.append)
    origin = {
        "name": arguments["name"], "version": arguments["version"], "robots": wanted.robots,
        "team": wanted.team,
    }  # fmt: skip
    steps = learning(
        found, wanted.detectors, wanted.false_alarms_per_hour, options_of(wanted.options), origin
    )
    while True:
        try:
            yield _line(LearningProgress(next(steps)))
        except StopIteration as end:
            model = end.value
            break
    file = place / arguments["file"]
    save_model(model, file)
    data = file.read_bytes()
    report = [*report_lines(model), *notes][:_MOST_LINES]
    yield _line(LearningProgress(1.0, len(data), hashlib.sha256(data).hexdigest(), report))


def detect(folder: Path, arguments: Mapping[str, Any]) -> bytes:
    """Return the alarms of a model in ``[from_ns, to_ns)`` as JSON, those of each robot.

    Those of a team are not of one robot. Detection begins anew with the range.
    """
    model = load_model(folder / FOLDER / arguments["id"] / arguments["file"])
    span, robots = (arguments["from_ns"], arguments["to_ns"]), arguments["robots"]
    ahead_ns = _ahead_ns(folder, robots) if arguments["team"] else {}
    members = {robot: _rows(folder, model, robot, span) for robot in robots}
    if arguments["team"]:
        found = {"": _alarms(model, team_rows(members, span, ahead_ns))}
    else:
        found = {robot: _alarms(model, rows) for robot, rows in members.items()}
    lines = [
        {**alarm_to_json(alarm), "robot": robot}
        for robot, alarms in found.items()
        for alarm in alarms[:_MOST_ALARMS]
    ]
    return msgspec.json.encode(lines)


def follow(folder: Path, arguments: Mapping[str, Any]) -> bytes:
    """Return how far a model of a team has come, as JSON, after at most ten minutes more of record.

    It goes as far as the record of every robot reaches; alarms do not depend on the steps.
    """
    place = folder / FOLDER / arguments["id"]
    state = msgspec.json.decode((place / FILE).read_bytes(), type=FollowState)
    robots, from_ns = arguments["robots"], state.until_ns
    ends = [_complete_ns(folder, robot, state) for robot in robots]
    to_ns = min(from_ns + STEP_NS, *ends)
    if to_ns <= from_ns:
        return msgspec.json.encode(msgspec.structs.replace(state, error=""))
    model = load_model(place / arguments["file"])
    detection = RecordDetection(model)
    if state.snapshot is None:
        detection.begin(from_ns)
    else:
        detection.resume(state.snapshot)
    members = {}
    for robot in robots:
        ahead_ns = state.ahead_ns.get(robot, 0)
        members[robot] = _rows(folder, model, robot, (from_ns - ahead_ns, to_ns - ahead_ns))
    changes = (
        {**alarm_to_json(one), "robot": ""}
        for one in detection.take_rows(
            team_rows(members, (from_ns, to_ns), state.ahead_ns), to_ns - 1
        )
        if isinstance(one, DetectorAlarm) and one.detector != COMBINED
    )
    alarms = with_changes(state.alarms, changes)
    found = FollowState(state.from_ns, to_ns, state.ahead_ns, detection.snapshot(), alarms)
    return msgspec.json.encode(found)


def _complete_ns(folder: Path, robot: str, state: FollowState) -> int:
    """Return up to when a robot's record is here, by the server's clock; the start without one."""
    ahead_ns = state.ahead_ns.get(robot, 0)
    span = state.until_ns - ahead_ns, None
    found = with_snapshot(folder, robot, RecordSnapshot.complete_ns, span)
    return state.until_ns if found is None else found + ahead_ns


def _rows(folder: Path, model: DetectionModel, robot: str, span: Span) -> RecordRows:
    """Return the rows of a robot that a model has learnt, its own or those of a team's member."""
    record = _record(folder, robot, span).record
    known = readable_items(record)
    learnt = learnt_items(model, known)
    items = tuple(name for name in known if {name, f"{robot}/{name}"} & learnt)
    return RecordRows(record, robot, span, items, short_lists(record, items))


def _alarms(model: DetectionModel, rows: MissionRows) -> list[DetectorAlarm]:
    """Return the alarms of all detectors in the order of their confirmation."""
    lasting: dict[tuple[str, str], int] = {}
    found: list[DetectorAlarm] = []
    changes = chain.from_iterable(_changes(detector, rows) for detector in model.detectors.values())
    for alarm in changes:
        key = alarm.detector, alarm.series
        if alarm.gone_ns is None:
            lasting[key] = len(found)
            found.append(alarm)
        elif key in lasting:
            found[lasting.pop(key)] = alarm
    return sorted(found, key=lambda alarm: alarm.confirmed_ns)


def _changes(detector: LearntDetector, rows: MissionRows) -> Iterator[DetectorAlarm]:
    start_ns, end_ns = rows.span
    yield from detector.begin(start_ns)
    for row in rows:
        yield from detector.update((row,))
    yield from detector.tick(end_ns)


def _ahead_ns(folder: Path, robots: Sequence[str]) -> dict[str, int]:
    """Return how far the server's clock is ahead of those of robots, as last known (ns)."""
    with open_catalogue(folder).database.reading() as connection:
        return clock_offsets_ns(connection, robots)


def _record(folder: Path, robot: str, within: Window) -> NominalRecord:
    record = SnapshotRecord(folder, open_catalogue(folder), (robot,), span=within)
    return NominalRecord(record, robot, missions(folder, robot))


def _line(progress: LearningProgress) -> bytes:
    return msgspec.json.encode(progress)
