"""The parts of the demonstration: the port, the way that is cut, orders to a robot, its folder."""

from __future__ import annotations

import asyncio
import json
import os
import signal
import socket
import subprocess
from contextlib import closing
from pathlib import Path

import pytest

import amberbox
from amberbox.agent.command_trust import read_trust, trust_path
from amberbox.blackbox.query import mission_search
from amberbox.blackbox.robot_folder.folder import load_folder
from amberbox.blackbox.robot_folder.robot_yaml import read_rules
from amberbox.blackbox.sources.sim import OrdersFile
from amberbox.cli.main import main
from amberbox.core.clock import NS
from amberbox.core.errors import AmberboxError, UsageError
from amberbox.demo.fleet import IDS, LiveDemo, Relay, robot_paths
from amberbox.demo.show import free_port
from amberbox.testing.clock import wait_until
from tests.support.processes import command


def test_a_port_that_is_taken_is_passed_over() -> None:
    with closing(socket.create_server(("127.0.0.1", 0))) as taken:
        port = int(taken.getsockname()[1])
        found = free_port(port)
        assert port < found < port + 50
    with pytest.raises(AmberboxError, match="are taken"):
        free_port(65536)


def test_nobody_gets_through_while_the_way_is_cut() -> None:
    asyncio.run(_cut_and_mend())


async def _cut_and_mend() -> None:
    async def echo(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        while piece := await reader.read(100):
            writer.write(piece)
        writer.close()

    server = await asyncio.start_server(echo, "127.0.0.1", 0)
    relay = Relay()
    await relay.begin(int(server.sockets[0].getsockname()[1]))
    reader, writer = await asyncio.open_connection("127.0.0.1", relay.port)
    writer.write(b"hello")
    assert await reader.readexactly(5) == b"hello"
    assert relay.was_used()
    relay.cut()
    with pytest.raises((ConnectionError, asyncio.IncompleteReadError)):
        await reader.readexactly(1)
    assert await _answers(relay.port) is False
    relay.mend()
    assert await _answers(relay.port) is True
    relay.close()
    server.close()


async def _answers(port: int) -> bool:
    try:
        reader, writer = await asyncio.open_connection("127.0.0.1", port)
        writer.write(b"x")
        return await reader.read(1) == b"x"
    except ConnectionError:
        return False


def test_the_robots_folders_are_right_and_report_to_the_server(tmp_path: Path) -> None:
    stage = LiveDemo(tmp_path, 18999)
    stage.prepare()
    assert len({stage.paths(robot).commands for robot in IDS}) == len(IDS)
    for robot in IDS:
        place = stage.paths(robot)
        assert main(["check", str(place.folder)]) == 0
        assert place.commands in (place.folder / "actions" / "sim.yaml").read_text()
        folder = load_folder(place.folder)
        named = trust_path(folder)
        assert named is not None and not named.is_relative_to(place.folder)
        people = read_trust(named).people
        assert people["technician"].key == json.loads(place.key.read_text())["public"]
        assert folder.robot.id == robot
        assert folder.robot.server is not None
        assert folder.robot.server.url.startswith("http://127.0.0.1:")
        assert (tmp_path / robot / "server.key").stat().st_mode & 0o077 == 0
        assert (tmp_path / robot / "fmea.yaml").exists()
    stage.close()


def test_what_is_not_offered_or_does_not_run_is_refused(tmp_path: Path) -> None:
    stage = LiveDemo(tmp_path, 18999)
    with pytest.raises(UsageError, match="no fault 'host_clock_jump'"):
        stage.damage(IDS[0], "host_clock_jump")
    with pytest.raises(UsageError, match="does not run"):
        stage.damage(IDS[0], stage.faults[0])
    assert stage.broken() == {}
    stage.close()


def test_orders_are_read_line_by_line_as_they_are_added(tmp_path: Path) -> None:
    path = tmp_path / "orders"
    orders = OrdersFile(path)
    assert orders.new() == []
    path.write_text("fault a\nfault b\nhea")
    assert orders.new() == ["fault a", "fault b"]
    assert orders.new() == []
    path.write_text("fault a\nfault b\nheal a\n")
    assert orders.new() == ["heal a"]


@pytest.mark.timeout(180)
def test_nothing_is_left_when_the_demonstration_is_killed(tmp_path: Path) -> None:
    place = tmp_path / "place"
    words = command("demo", "--seconds", "60", "--keep", place, "--port", "18543")
    process = subprocess.Popen(words, stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL)
    wait_until(lambda: len(_working_below(place)) > 4, "its processes run")
    process.send_signal(signal.SIGKILL)
    process.wait()
    wait_until(lambda: _working_below(place) == [], "their end")


def _working_below(place: Path) -> list[str]:
    found = []
    for entry in Path("/proc").iterdir():
        if entry.name.isdigit() and int(entry.name) != os.getpid():
            try:
                command = (entry / "cmdline").read_bytes().replace(b"\0", b" ").decode()
            except OSError:  # it ended meanwhile
                continue
            if str(place) in command:
                found.append(command)
    return found


def test_deliveries_of_the_robots_are_missions_and_fail_when_it_cannot_drive(
    tmp_path: Path,
) -> None:
    LiveDemo(tmp_path, 18999).prepare()
    place = robot_paths(IDS[0], tmp_path)
    box = (place.folder / "black_box.yaml").read_text()
    assert "scenario: shuttle\n" in box
    hurried = "    speed: max\n    duration_s: 120\n    topics: [{name: tasks}]\n"
    fault = "    faults: [{id: bumper_switch_closed, at_s: 40}]\n"
    (place.folder / "black_box.yaml").write_text(f"{box}{hurried}{fault}")
    rules = read_rules(place.folder)
    (place.folder / "robot.yaml").write_text("id: r\n")  # no keeper that is ended on its way
    assert main(["record", str(place.folder), "--quiet"]) == 0
    mission_search.detect(place.folder / "store", rules)
    found = amberbox.open(place.folder).missions()
    assert [(m.name, m.outcome, m.failed, m.parameters["to"]) for m in found[:2]] == [
        ("delivery", "finished", False, "ward_a"),
        ("delivery", "timeout", True, "charging_station"),
    ]
    seconds = [((m.to_ns or 0) - m.from_ns) / NS for m in found[:2]]
    assert seconds == pytest.approx([24, 45], abs=1.5)
