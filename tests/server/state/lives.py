"""Robots that live in a test: they connect, say statuses, and have a folder."""

from __future__ import annotations

import math
from dataclasses import asdict
from typing import Any

import msgspec

from amberbox.blackbox.journal import channels
from amberbox.core.clock import NS
from amberbox.core.robot_status import Severity
from amberbox.link.folders import pack
from amberbox.link.frames import BeatFrame, Hello, JournalPosition, LinkRow, RunEnd, WriterReach
from amberbox.link.server_end import ServerEnd
from amberbox.server.alarms.alarm import Alarm
from amberbox.server.ingest import ledger, link_state
from amberbox.server.ingest.link_server import RobotConnection
from amberbox.server.schema import ALARM, ALARM_ROBOT
from tests.server.house import House
from tests.support.sockets import FakeSocket

BOOT = "00c0ffee-0000-4000-8000-000000000000"
HASH = "ab" * 32
FILES = {
    "robot.yaml": b"id: ropod_001\nmodel: Ropod 2\n",
    "black_box.yaml": b"- ros:\n    topics:\n      - topic: {name: /scan}\n",
    "components/laser.yaml": b"""component_name: laser
description: sees obstacles
modes: [laser/device.yaml]
dependencies: []
""",
    "components/laser/device.yaml": b"""name: laser_device_monitor
mappings:
    - mapping:
        inputs: [/dev/front_laser]
        outputs:
            - output: {name: front_laser_working, type: bool, expected: true}
""",
    "components/navigation.yaml": b"""component_name: navigation
modes: []
dependencies: [laser]
""",
}


def connect(home: House, robot: str, *, ahead_ns: int = 0, config_hash: str = "") -> None:
    """Let a robot be connected; the server's clock is so far ahead of its own."""
    now_ns = home.clock.wall_ns()
    reach = WriterReach(
        JournalPosition(1, 0),
        JournalPosition(1, 0),
        JournalPosition(1, 0),
        (RunEnd(1, BOOT[:8], 0, closed=False),),
    )
    hello = Hello(robot, "s", BOOT, {"watch": reach}, config_hash, now_ns - ahead_ns, 0, "0.6")
    with home.services.database.begin() as connection:
        admission = ledger.admit(connection, hello, now_ns)
        beat = BeatFrame(admission.epoch, 0, 0, 7, ahead_ns, 2_000_000, 900)
        link_state.record_heartbeat(connection, robot, admission.epoch, beat, BOOT, now_ns)
    one = RobotConnection(robot, FakeSocket(), ServerEnd(robot), now_ns)
    one.backlog, one.last_received_s = 7, math.inf  # it is heard for as long as the test lasts
    home.services.links.robots[robot] = one


def say(home: House, robot: str, channel: str, at_ns: int, seq: int, values: Any) -> LinkRow:
    """Let a record arrive; tell nobody."""
    data = msgspec.json.encode(values)
    row = LinkRow("watch", 1, seq, channel, at_ns, data)
    with home.services.database.begin() as connection:
        about = {"robot": robot, "store_id": "s", "received_ns": home.clock.wall_ns()}
        ledger.insert(connection, [{**about, **ledger.columns(row)}])
        newest = link_state.newest_statuses(robot, "s", [row], home.clock.wall_ns())
        link_state.write_statuses(connection, newest)
    return row


def status(component: str, level: str, at_ns: int, **more: Any) -> dict[str, Any]:
    """Return a status as the watcher writes it."""
    return {"robot": "r", "component": component, "mode": "", "level": level, "state": level,
            "outputs": [], "blocked_by": [], "measured_ns": at_ns, "since_ns": at_ns - 60 * NS,
            "reason": "", "config_hash": HASH, "live_only": False, **more}  # fmt: skip


def transition(component: str, before: str, after: str, at_ns: int) -> dict[str, Any]:
    """Return the event of a change."""
    details = {"robot": "r", "component": component, "mode": "", "at_ns": at_ns,
               "before": {"level": before, "state": before},
               "after": {"level": after, "state": after}, "reason": f"now {after}"}  # fmt: skip
    text = msgspec.json.encode(details).decode()
    return {"kind": "component_state", "text": f"{component}: {before} -> {after}",
            "source": "watch", "details": text}  # fmt: skip


def keep_folder(home: House, robot: str) -> None:
    """Let a robot's folder be here."""
    assert home.services.folders.keep(robot, HASH, pack(FILES))


def put_alarm(home: House, number: int, *robots: str, severity: Severity = "urgent") -> None:
    """Let an alarm be open."""
    one = robots[0] if len(robots) == 1 else ""
    alarm = Alarm(number, "robot", one, "laser", severity, "error", "dead", 1, 1)
    with home.services.database.begin() as connection:
        connection.execute(ALARM.insert(), [asdict(alarm)])
        rows = [{"alarm": number, "robot": robot, "from_ns": 1, "to_ns": None} for robot in robots]
        connection.execute(ALARM_ROBOT.insert(), rows)


STATUS, EVENT, MISSION = channels.STATUS, channels.EVENT, channels.MISSION
