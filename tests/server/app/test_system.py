"""The system level: members' statuses on arrival, a monitored team, its statuses."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from amberbox.blackbox.journal import channels
from amberbox.blackbox.store.own_records import newest_records
from amberbox.core.clock import NS, SystemClock
from amberbox.core.pacing import Backoff
from amberbox.core.types import Status
from amberbox.link.frames import Hello, LinkRow
from amberbox.monitoring.findings import encoded
from amberbox.server import system
from amberbox.server.bus import ServerChange
from amberbox.server.system import (
    FRESH_NS,
    FolderRunner,
    MemberRecord,
    MemberStore,
    RecordLateness,
    look,
    paths,
)
from amberbox.testing.clock import PATIENCE_S
from tests.server.house import House

DEADLINE_S = 60.0
"""Long enough for a computer with other work to do; it takes a tenth of that."""
WORKS = """\
name: works
monitor: expected
mappings:
  - mapping:
      inputs: [{robot}_robot.level]
      outputs: [{{output: {{name: works, type: bool}}}}]
arguments: {{one_of: [ok, warn]}}
"""
SYSTEM = {
    "robot.yaml": "id: system\nstore: {quota: 50 MB, min_free: 1 MB}\n",
    "black_box.yaml": "- status: {name: ropod_001, where: ../members/ropod_001}\n"
                      "- status: {name: ropod_002, where: ../members/ropod_002}\n",
    "components/ropod_001.yaml": "component_name: ropod_001\nmodes: [r/one.yaml]\n",
    "components/ropod_002.yaml": "component_name: ropod_002\nmodes: [r/two.yaml]\n",
    "components/carts.yaml": "component_name: carts\npolicy: any\n"
                             "modes: [r/one.yaml, r/two.yaml]\n",
    "components/r/one.yaml": WORKS.format(robot="ropod_001"),
    "components/r/two.yaml": WORKS.format(robot="ropod_002").replace("works\nm", "two_works\nm"),
    "fmea.yaml": "types:\n  robot:\n    failure_modes:\n      lost: {probability: 0.01, "
                 "symptoms: [ropod_002/two_works/works]}\ninstances: {robot: [ropod_002]}\n",
}  # fmt: skip


def write(folder: Path, files: Mapping[str, str]) -> None:
    for name, text in files.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(text, encoding="utf-8")


def status(robot: str, at_ns: int, level: Any = "ok") -> Status:
    return Status(robot, "laser", "", level, "nominal", {}, (), at_ns, at_ns, "why", "c")


def row(robot: str, at_ns: int, seq: int, level: Any = "ok") -> LinkRow:
    channel, data = encoded(status(robot, at_ns, level))
    return LinkRow("watch", 1, seq, channel, at_ns, data)


class Robots:
    """Robots that send over the link in the present: hello, then rows."""

    def __init__(self, home: House, now_ns: int) -> None:
        self.home, self.seq = home, 0
        for robot in ("ropod_001", "ropod_002"):
            hello = Hello(robot, "s", "b", {}, "", now_ns, 0, "1")
            home.services.bus.publish(ServerChange("connected", robot, {"hello": hello}))

    def say(self, robot: str, at_ns: int, level: str = "ok") -> None:
        self.seq += 1
        rows = [row(robot, at_ns, self.seq, level)]
        self.home.services.bus.publish(ServerChange("rows", robot, {"store_id": "s", "rows": rows}))


async def _until(home: House, robots: Robots, wanted: Mapping[str, str], *speak: str) -> None:
    """Let some robots send every half second until the system's components have given levels."""
    end_s = time.monotonic() + DEADLINE_S
    levels: dict[str, str] = {}
    while time.monotonic() < end_s:
        for robot in speak:
            robots.say(robot, SystemClock().wall_ns())
        await asyncio.sleep(0.3)
        place = home.services.folder / "system" / "store"
        levels = {s.component: s.level for s in system.statuses(place) if not s.mode}
        if wanted.items() <= levels.items():
            return
    raise AssertionError(f"{levels}; {home.services.system.watched()}")


def test_a_system_is_watched_by_what_its_robots_send(home: House) -> None:
    """With the real recorder and watcher; an error in one file does not stop the others."""
    home.services.system._clock = SystemClock()  # the processes have no other
    wrong = {"components/x.yaml": "component_name: x\nmodez: []\n"}
    write(home.services.folder / "system", {**SYSTEM, **wrong})

    async def play() -> None:
        home.services.bus.attach(asyncio.get_running_loop())
        running = asyncio.create_task(home.services.system.run())
        robots = Robots(home, SystemClock().wall_ns())
        both = {"ropod_001": "ok", "ropod_002": "ok", "carts": "ok"}
        await _until(home, robots, both, "ropod_001", "ropod_002")
        await _until(home, robots, {"ropod_002": "stale", "carts": "ok"}, "ropod_001")
        running.cancel()
        await asyncio.gather(running, return_exceptions=True)

    asyncio.run(play())
    (folder,) = home.client("viewer").get("/api/v1/system/status").json()
    assert (folder["name"], folder["members"]) == ("system", ["ropod_001", "ropod_002"])
    assert folder["state"] == "off"
    levels = {s["component"]: s["level"] for s in folder["statuses"] if not s["mode"]}
    assert levels["ropod_002"] == "stale"
    errors = [(p["file"], p["what"]) for p in folder["problems"] if p["is_error"]]
    assert errors == [("components/x.yaml", "unknown key 'modez'; did you mean 'modes'?")]
    left = [p for p in Path("/proc").glob("[0-9]*/cmdline") if _names(p, str(home.services.folder))]
    assert left == []


def _names(cmdline: Path, folder: str) -> bool:
    try:
        return folder.encode() in cmdline.read_bytes()
    except OSError:
        return False


def test_what_is_wrong_with_a_folder_is_shown(home: House) -> None:
    wrong = {**SYSTEM, "black_box.yaml": "- status: {nam: a, where: ../members/ropod_001}\n"}
    write(home.services.folder / "system", wrong)

    async def play() -> None:
        await home.services.system.look()

    asyncio.run(play())
    (folder,) = home.client("viewer").get("/api/v1/system/status").json()
    assert folder["state"] == "refused"
    problem = next(p for p in folder["problems"] if p["is_error"])
    assert (problem["file"], problem["line"]) == ("black_box.yaml", 1)
    assert "unknown key 'nam'" in problem["what"]


def test_it_is_for_those_who_see_all_robots(home: House) -> None:
    for path in ("status", "diagnoses"):
        assert home.client("nurse").get(f"/api/v1/system/{path}").status_code == 403
        assert home.client("viewer").get(f"/api/v1/system/{path}").json() == []


def test_teams_stand_beside_the_system(tmp_path: Path) -> None:
    write(tmp_path / "teams" / "transport", SYSTEM | {
        "black_box.yaml": "- status: {name: ropod_001, where: ../../members/ropod_001}\n"
                          "- status: {name: other, where: ../../../elsewhere/ropod_009}\n"
    })  # fmt: skip
    write(tmp_path / "system", SYSTEM)
    (tmp_path / "teams" / "empty").mkdir()
    assert list(paths(tmp_path)) == ["transport", "system"]
    team = look(tmp_path, "transport", tmp_path / "teams" / "transport")
    assert team.members == frozenset({"ropod_001"})
    assert team.store == tmp_path / "teams" / "transport" / "store"


def _said(store: Path) -> list[int]:
    found = newest_records(MemberStore(store, SystemClock()).store, "watch", {channels.STATUS}, 1e9)
    return [record.values["measured_ns"] for record in found]


def test_a_member_is_written_as_its_own_watcher_would(tmp_path: Path) -> None:
    member = MemberStore(tmp_path / "ropod_001", SystemClock())
    at_ns = 1_800_000_000 * NS
    rows = [row("ropod_001", at_ns + n * NS, n) for n in (0, 2, 1)]
    member.write([MemberRecord(r.channel, r.log_ns, r.data) for r in rows])
    member.close()
    assert _said(tmp_path / "ropod_001") == [at_ns, at_ns + 2 * NS, at_ns + NS]


def test_a_members_store_stays_small(tmp_path: Path) -> None:
    member = MemberStore(tmp_path / "ropod_001", SystemClock())
    for number in range(8):
        one = row("ropod_001", (1_800_000_000 + 700 * number) * NS, number)
        member.write([MemberRecord(one.channel, one.log_ns, one.data)])
    member.close()
    assert len(member.store.journal_files("watch")) <= 4


LATE_S = 8 * 3600


def test_a_backlog_is_not_taken_for_now() -> None:
    late = RecordLateness(ahead_ns=0, since_ns=0)
    now_ns = 10_000 * NS
    assert late.of(("s", 1), now_ns - LATE_S * NS, now_ns, backlog=5000) > FRESH_NS
    assert late.of(("s", 1), now_ns - NS, now_ns, backlog=0) == NS


def test_the_clock_of_a_member_may_say_1970() -> None:
    now_ns = 1_800_000_000 * NS
    late = RecordLateness(ahead_ns=now_ns - 100 * NS, since_ns=now_ns)
    assert late.of(("s", 1), 101 * NS, now_ns + NS, backlog=0) == 0


def test_log_time_may_differ_from_the_clock_that_was_put_right() -> None:
    """When the robot has no backlog, its records count as present."""
    now_ns = 1_800_000_000 * NS
    late = RecordLateness(ahead_ns=0, since_ns=now_ns)
    behind = now_ns - 3600 * NS
    assert late.of(("s", 1), behind, now_ns, backlog=0) > FRESH_NS
    assert late.of(("s", 1), behind + 5 * NS, now_ns + 5 * NS, backlog=0) == 0
    assert late.of(("s", 1), behind + 5 * NS, now_ns + 8 * NS, backlog=5000) == 3 * NS


def test_what_ends_is_started_again_later_each_time() -> None:
    runner = FolderRunner(Path(), ["/bin/sh", "-c", "echo 'error: no room' >&2; exit 2"],
                    Backoff(least_s=0.05, most_s=0.1))  # fmt: skip

    async def play() -> None:
        task = asyncio.create_task(runner.run())
        while runner.restarts < 3:
            await asyncio.sleep(0.02)
        task.cancel()
        await asyncio.gather(task, return_exceptions=True)

    asyncio.run(asyncio.wait_for(play(), PATIENCE_S))
    assert runner.trouble == "no room"


def test_what_runs_is_ended_with_the_server() -> None:
    runner = FolderRunner(Path(), ["/bin/sleep", "100"])

    async def play() -> int:
        task = asyncio.create_task(runner.run())
        while runner._process is None:
            await asyncio.sleep(0.02)
        pid = runner._process.pid
        task.cancel()
        await asyncio.gather(task, return_exceptions=True)
        return pid

    pid = asyncio.run(asyncio.wait_for(play(), PATIENCE_S))
    assert not Path(f"/proc/{pid}").exists()
