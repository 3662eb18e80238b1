"""A simulated robot's folder and the findings of its watcher, stored as if sent over the link."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Any

from amberbox import sim
from amberbox.consult.folder_knowledge import read_declared_robot
from amberbox.core.clock import NS
from amberbox.core.types import Diagnosis, Output, Status, Symptom
from amberbox.diagnosis.diagnose import DiagnosisId, ObservedSituation, answer
from amberbox.diagnosis.knowledge import Knowledge
from amberbox.link.folders import pack
from amberbox.link.frames import LinkRow
from amberbox.link.server_end import ServerEnd
from amberbox.monitoring.findings import Finding, encoded
from amberbox.server.ingest import link_state
from amberbox.server.ingest.link_server import RobotConnection
from amberbox.server.schema import ROBOT, ROW
from tests.server.house import House
from tests.support.sockets import FakeSocket

FOLDER = Path(sim.__file__).parent / "folder"
HASH = "5eed" * 16
STORE = "4f1c0e1e-0000-4000-8000-000000000001"
AT_NS = 1_799_999_000 * NS
DIAGNOSIS = "ropod_001-20270115t075000"
NO_SCANS = "laser_front/heartbeat/alive"


def files() -> dict[str, bytes]:
    """Return the files of the simulated robot's folder."""
    found = (path for path in FOLDER.rglob("*") if path.is_file())
    return {path.relative_to(FOLDER).as_posix(): path.read_bytes() for path in found}


def hand_in(
    home: House, robot: str = "ropod_001", hash_: str = HASH,
    more: Mapping[str, bytes] | None = None,
) -> None:  # fmt: skip
    """Hand in the robot's folder, with more files (or others) in it."""
    home.services.folders.keep(robot, hash_, pack({**files(), **(more or {})}))


def symptom(name: str, at_ns: int, state: Any = "present") -> Symptom:
    onset_ns = at_ns if state == "present" else None
    return Symptom(name, state, name, onset_ns, at_ns)


def status(
    component: str, at_ns: int, mode: str = "", config_hash: str = HASH, **outputs: Output
) -> Status:
    return Status("ropod_001", component, mode, "error" if False in outputs.values() else "ok",
                  "nominal", outputs, (), at_ns, at_ns, "why", config_hash)  # fmt: skip


@cache
def knowledge(robot: str = "ropod_001", hash_: str = HASH) -> Knowledge:
    """Return what the folder says can fail."""
    return read_declared_robot(FOLDER, robot, hash_).knowledge()


def diagnosis(at_ns: int, *symptoms: Symptom) -> Diagnosis:
    """Return the diagnosis of these symptoms by the watcher's own engine."""
    situation = ObservedSituation(symptoms, watched=True)
    return answer(knowledge(), situation, DiagnosisId(DIAGNOSIS, 1, at_ns))


def say(
    home: House, found: Sequence[tuple[int, Finding]], robot: str = "ropod_001", start: int = 0
) -> None:
    """Store findings as if sent over the link, each written at an instant."""
    rows = []
    for seq, (at_ns, finding) in enumerate(found, start):
        channel, data = encoded(finding)
        rows.append(
            {"robot": robot, "store_id": STORE, "writer": "watch", "run": 1, "seq": seq,
             "channel": channel, "log_ns": at_ns, "data": data, "received_ns": at_ns}
        )  # fmt: skip
    with home.services.database.begin() as connection:
        connection.execute(ROW.insert(), rows)


def is_here(home: House, robot: str = "ropod_001") -> None:
    """Connect a robot whose watcher reports all components as ok."""
    now_ns = home.clock.wall_ns()
    link = RobotConnection(robot, FakeSocket(), ServerEnd(robot), now_ns)
    link.last_received_s = math.inf
    home.services.links.robots[robot] = link
    channel, data = encoded(status("laser_front", now_ns))
    with home.services.database.begin() as connection:
        row = LinkRow("watch", 1, 9_999, channel, now_ns, data)
        newest = link_state.newest_statuses(robot, STORE, [row], now_ns)
        link_state.write_statuses(connection, newest)


def state(home: House, robot: str = "ropod_001", config_hash: str = HASH) -> None:
    """Let a robot have connected once."""
    row = {"robot": robot, "epoch": 1, "store_id": STORE, "boot_id": "b",
           "config_hash": config_hash, "version": "1", "connected": False, "connected_ns": AT_NS,
           "last_seen_ns": AT_NS, "backlog": 0, "backlog_bytes": 0}  # fmt: skip
    with home.services.database.begin() as connection:
        connection.execute(ROBOT.insert(), [row])
