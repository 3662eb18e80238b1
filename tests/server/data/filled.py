"""A server with a record: journals of a robot in columns, one that waits, and missions."""

from __future__ import annotations

from pathlib import Path

import msgspec

from amberbox.blackbox.journal import channels
from amberbox.core.clock import NS
from amberbox.testing.records import T0_NS, FakeItem, FakeRun
from tests.server.archive.recordings import Robot
from tests.server.house import House

ROWS = 120
"""Rows of ``odom`` of ``ropod_001`` in columns; 40 more wait."""

FORMULAS = ('=HYPERLINK("http://evil.example")', "+1", "-1", "@SUM(A1)", "\tx", "\rx")
"""What a spreadsheet would take for a formula."""

_NOTE = FakeItem("note", [{"text": "x"}])


def fill(home: House, folder: Path) -> Robot:
    """Record two robots; commit the journals of the first one except its last."""
    archive = home.services.archive
    robot = Robot("ropod_001", folder)
    robot.record(0)
    _extras(robot)
    robot.hand_in_all(archive)
    other = Robot("ropod_003", folder)
    other.record(500, files=1)
    other.hand_in_all(archive)
    archive.commit(0)
    known = set(robot.files())
    robot.record(ROWS, files=1)
    for path in robot.files():
        if path not in known:
            robot.hand_in(archive, path)
    return robot


def _extras(robot: Robot) -> None:
    """Record texts, a mission that ended and one that lasts, an incident."""
    notes = FakeRun(robot.store, items=[_NOTE])
    texts = [*FORMULAS, "plain"]
    notes.write([(T0_NS + n, _NOTE, {"text": text}) for n, text in enumerate(texts)])
    notes.close()
    keeper = FakeRun(robot.store, "keep")
    start = {"received_ns": T0_NS}
    for state, end_ns in (("started", None), ("ended", T0_NS + NS // 2)):
        end = None if end_ns is None else {"received_ns": end_ns}
        details = {"failed": end is not None, "parameters": {"to": "B"}, "start": start, "end": end}
        mission = {"id": "transport-1", "name": "transport", "state": state,
                   "outcome": "aborted" if end else "", "from_ns": T0_NS, "to_ns": end_ns,
                   "who": "rule", "details": msgspec.json.encode(details).decode()}  # fmt: skip
        keeper.own(channels.MISSION, end_ns or T0_NS, mission)
    for state in ("open", "complete"):
        incident = {"id": "incident-1", "state": state, "reason": "it bumped", "who": "",
                    "trigger": "bump", "from_ns": T0_NS, "to_ns": T0_NS + NS}  # fmt: skip
        keeper.own(channels.INCIDENT, T0_NS + NS, incident)
    keeper.close()
