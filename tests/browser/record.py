"""What ``ropod_001`` recorded in the last hour: numbers, labels, texts, a spike, a gap."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from amberbox.blackbox.journal import channels
from amberbox.core.clock import NS
from amberbox.core.types import Schema, Topic
from amberbox.testing.records import FakeItem, FakeRun
from tests.browser import hostile

MINUTE_NS = 60 * NS
BEGIN_NS = -55 * MINUTE_NS
"""All times of this record are given from now on backwards."""
GAP_NS = (-30 * MINUTE_NS, -27 * MINUTE_NS)
"""A gap of ``ros_ropod_odom``, with its reason in the record."""
LOST = "lost: the queue was full"
SPIKE_NS, SPIKE = -40 * MINUTE_NS, 99.0
"""One sample of ``ros_ropod_odom.twist_linear_x`` is this."""
ODOM_HZ = 50
COMMITTED_NS, END_NS = -10 * MINUTE_NS, -1 * MINUTE_NS
"""Up to where there are columns, and up to where there are journals on the server."""

ODOM = "ros_ropod_odom"
BATTERY = FakeItem(
    "battery", [{"volts": 1.5, "charge_percent": 80.5, "charging": False}], "/ropod/battery",
    variables=["volts", "charge_percent", "charging"],
)  # fmt: skip
HOSTILE = FakeItem(
    hostile.ITEM, [{"text": "x", **dict.fromkeys(hostile.FIELDS, 1.5)}], "/ropod/hostile"
)
_ODOM_TOPIC = Topic("/ropod/odom", "ros1", Schema("ropod/Odom", "ros1msg", b"""time stamp
float64 pose_x
float64 pose_y
geometry_msgs/Twist twist
================================================================================
MSG: geometry_msgs/Twist
geometry_msgs/Vector3 linear
================================================================================
MSG: geometry_msgs/Vector3
float64 x
"""))  # fmt: skip
_DRIVE_TOPIC = Topic("/ropod/drive", "ros1", Schema("ropod/Drive", "ros1msg", b"""uint8 STATE_IDLE=0
uint8 STATE_DRIVING=1
uint8 STATE_BLOCKED=2
uint8 state
bool enabled
string remark
"""))  # fmt: skip
_REMARKS = ("", "turning", "waits for the lift")


@dataclass(frozen=True)
class _Raw:
    """Messages of one topic as stored in a journal."""

    item: str
    topic: Topic
    at_ns: Sequence[int] | NDArray[np.int64]
    messages: Sequence[bytes]
    stamp: str = ""


def write_record(store: Path, now_ns: int, boot: str) -> None:
    """Write the journals of ``main``: one for each ten minutes."""
    run = FakeRun(store, items=[BATTERY, HOSTILE], boot=boot)
    for start_ns in range(BEGIN_NS, END_NS, 10 * MINUTE_NS):
        window = now_ns + start_ns, now_ns + min(start_ns + 10 * MINUTE_NS, END_NS)
        if start_ns > BEGIN_NS:
            run.rotate()
        run.clock(window[0] - 1, 0)
        run.start(window[0] - 1)
        for raw in (odom(now_ns, *window), drive(now_ns, *window)):
            _write_raw(run, raw)
        run.write(_slow_rows(now_ns, *window))
    run.close()


def write_kept(store: Path, now_ns: int, boot: str) -> None:
    """Write the journal of ``keep``: missions, an incident, why something is missing."""
    run = FakeRun(store, "keep", boot=boot)
    for values in _missions(now_ns):
        run.own(channels.MISSION, values["to_ns"] or values["from_ns"], values)
    for state in ("open", "complete"):
        incident = {"id": "incident-1", "state": state, "reason": "bumper pressed", "who": "",
                    "trigger": "bump", "from_ns": now_ns - 36 * MINUTE_NS,
                    "to_ns": now_ns - 34 * MINUTE_NS}  # fmt: skip
        run.own(channels.INCIDENT, now_ns - 34 * MINUTE_NS, incident)
    from_ns, to_ns = (now_ns + at_ns for at_ns in GAP_NS)
    gap = {"item": ODOM, "peer": "", "from_ns": from_ns, "to_ns": to_ns, "reason": LOST,
           "count": (to_ns - from_ns) // NS * ODOM_HZ}  # fmt: skip
    run.own(channels.GAP, to_ns, gap)
    run.close()


def odom(now_ns: int, from_ns: int, to_ns: int) -> _Raw:
    """Return poses on a circle, speeds with one spike; none in the gap."""
    at_ns = np.arange(from_ns, to_ns, NS // ODOM_HZ)
    in_gap = (at_ns >= now_ns + GAP_NS[0]) & (at_ns < now_ns + GAP_NS[1])
    at_ns = at_ns[~in_gap]
    seconds = (at_ns - (now_ns + BEGIN_NS)) / NS
    kind = [("s", "<u4"), ("n", "<u4"), ("x", "<f8"), ("y", "<f8"), ("v", "<f8")]
    rows = np.zeros(len(at_ns), kind)
    stamp_ns = at_ns - 2_000_000
    rows["s"], rows["n"] = stamp_ns // NS, stamp_ns % NS
    rows["x"], rows["y"] = 4 * np.cos(seconds / 30), 4 * np.sin(seconds / 30)
    rows["v"] = 0.5 + 0.1 * np.sin(seconds / 7)
    rows["v"][np.abs(at_ns - (now_ns + SPIKE_NS)) < NS // ODOM_HZ // 2] = SPIKE
    raw, size = rows.tobytes(), rows.dtype.itemsize
    messages = [raw[n : n + size] for n in range(0, len(raw), size)]
    return _Raw(ODOM, _ODOM_TOPIC, at_ns, messages, "stamp")


def drive(now_ns: int, from_ns: int, to_ns: int) -> _Raw:
    """Return a state with labels, a bool and a text, every two seconds."""
    at_ns = range(from_ns, to_ns, 2 * NS)
    return _Raw("ros_ropod_drive", _DRIVE_TOPIC, at_ns, [_drive(n) for n in range(len(at_ns))])


def _drive(number: int) -> bytes:
    state = number // 15 % 3
    remark = _REMARKS[state].encode()
    return bytes([state, state == 1]) + len(remark).to_bytes(4, "little") + remark


def _slow_rows(now_ns: int, from_ns: int, to_ns: int) -> list[tuple[int, FakeItem, Any]]:
    """Return the battery each two seconds, which empties; a hostile text each minute."""
    rows: list[tuple[int, FakeItem, Any]] = []
    for at_ns in range(from_ns + 1, to_ns, 2 * NS):
        share = (at_ns - now_ns - BEGIN_NS) / -BEGIN_NS
        values = {"volts": 28.0 - 3 * share, "charge_percent": 95 - 30 * share,
                  "charging": share < 0.1}  # fmt: skip
        rows.append((at_ns, BATTERY, values))
    for number, at_ns in enumerate(range(from_ns + 2, to_ns, MINUTE_NS)):
        text = hostile.TEXTS[number % len(hostile.TEXTS)]
        rows.append((at_ns, HOSTILE, {"text": text, **dict.fromkeys(hostile.FIELDS, number / 2)}))
    return sorted(rows, key=lambda row: row[0])


def _write_raw(run: FakeRun, raw: _Raw) -> None:
    marks = {"item": raw.item, "source": "ros", "stamp": raw.stamp}
    channel = run.journal.channel(raw.topic, marks)
    at_ns = np.asarray(raw.at_ns, np.int64)
    if len(at_ns):
        run.journal.write(np.full(len(at_ns), channel), at_ns, at_ns, raw.messages)


def _missions(now_ns: int) -> list[dict[str, Any]]:
    """Return missions with their begin and end; the last one is active."""
    said = (
        ("transport-1", "transport", -50, -38, "succeeded"),
        ("transport-2", hostile.MISSION, -33, -20, "failed"),
        ("transport-3", "transport", -12, None, ""),
    )
    rows = []
    for name, kind, start, end, outcome in said:
        from_ns = now_ns + start * MINUTE_NS
        to_ns = None if end is None else now_ns + end * MINUTE_NS
        rows.append(_mission(name, kind, from_ns, None, ""))
        if to_ns is not None:
            rows.append(_mission(name, kind, from_ns, to_ns, outcome))
    return rows


def _mission(name: str, kind: str, from_ns: int, to_ns: int | None, outcome: str) -> dict[str, Any]:
    end = None if to_ns is None else {"received_ns": to_ns}
    details = {"failed": outcome == "failed", "parameters": {"to": "ward 4"},
               "start": {"received_ns": from_ns}, "end": end}  # fmt: skip
    return {"id": name, "name": kind, "state": "ended" if end else "started", "outcome": outcome,
            "from_ns": from_ns, "to_ns": to_ns, "who": "rule",
            "details": msgspec.json.encode(details).decode()}  # fmt: skip
