"""docs/robot/teams.md: two simulated robots make a team, the team is part of a system."""

from __future__ import annotations

import json
import re
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pytest
import zmq

from amberbox.blackbox.robot_folder.folder import load_folder
from amberbox.blackbox.store.store import create_store, open_store
from amberbox.cli.main import main
from amberbox.core.types import Level, Status
from amberbox.monitoring.current_state import CurrentState, CurrentStateReader
from amberbox.monitoring.plan_loader import load_plan
from amberbox.monitoring.watcher import RecordWatcher, WatcherSetup
from amberbox.testing.clock import PATIENCE_S
from tests.support.manual_recorder import recording

PAGE = Path(__file__).resolve().parents[2] / "docs" / "robot" / "teams.md"
ROBOT = """\
- sim:
    topics:
      - topic: {name: odom}
"""
COMPONENT = """\
component_name: base
modes: [base/heartbeat.yaml]
"""
HEARTBEAT = """\
name: base_heartbeat_monitor
monitor: heartbeat
mappings:
  - mapping:
      inputs: [sim_odom]
      outputs:
        - output: {name: base_alive, type: bool}
"""


def files_of_the_page() -> dict[str, str]:
    """Return the files that the page shows, by path."""
    found = re.findall(r"^`([\w/.]+)`\n\n```yaml\n(.*?)^```", PAGE.read_text("utf-8"), re.M | re.S)
    return dict(found)


def write(root: Path, files: dict[str, str]) -> None:
    for name, text in files.items():
        path = root / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)


@pytest.fixture
def world(tmp_path: Path) -> Path:
    """Two small robots, and the team and the system of the page."""
    write(tmp_path, files_of_the_page())
    for name in ("ropod_001", "ropod_002"):
        robot = {
            "robot.yaml": f"id: {name}\n",
            "black_box.yaml": ROBOT,
            "components/base.yaml": COMPONENT,
            "components/base/heartbeat.yaml": HEARTBEAT,
        }
        write(tmp_path / name, robot)
    return tmp_path


@contextmanager
def watching(folder: Path) -> Iterator[None]:
    """Run the watcher of a robot folder in a thread."""
    loaded = load_folder(folder)
    plan, problems = load_plan(loaded)
    assert not [problem for problem in problems if problem.is_error]
    watcher = RecordWatcher(WatcherSetup(plan, create_store(loaded.store_path), loaded))
    stop = threading.Event()
    thread = threading.Thread(target=watcher.run, args=(stop,))
    thread.start()
    try:
        yield
    finally:
        stop.set()
        thread.join(PATIENCE_S)
        assert not thread.is_alive()


@dataclass
class Level1:
    """The running processes of one folder."""

    folder: Path
    watch: ExitStack = field(default_factory=ExitStack)
    record: ExitStack = field(default_factory=ExitStack)

    def start(self) -> None:
        self.record.enter_context(recording(self.folder))
        self.watch.enter_context(watching(self.folder))

    def board(self) -> CurrentState:
        return CurrentStateReader(open_store(self.folder / "store")).read(time.time_ns())

    def wait_for(self, component: str, level: Level) -> Status:
        """Wait until a component has a level."""
        until = time.monotonic() + PATIENCE_S
        while time.monotonic() < until:
            status = self.board().components.get(component)
            if status is not None and status.level == level:
                return status
            time.sleep(0.05)
        raise TimeoutError(f"{component} is not {level}: {self.board()}")


def test_the_page_passes_check(world: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for name in ("transport_team", "system"):
        assert main(["check", str(world / name)]) == 0, capsys.readouterr().out


def test_member_team_and_system(world: Path, capsys: pytest.CaptureFixture[str]) -> None:
    levels = {
        name: Level1(world / name)
        for name in ("ropod_001", "ropod_002", "transport_team", "system")
    }
    team, system = levels["transport_team"], levels["system"]
    with ExitStack() as stack:
        for level in levels.values():
            stack.push(level.record)
            stack.push(level.watch)
            level.start()
        assert main(["status", str(system.folder), "carts", "--wait", "30s"]) == 0
        team.wait_for("ropod_001", "ok")
        team.wait_for("ropod_002", "ok")
        levels["ropod_002"].watch.close()
        stale = team.wait_for("ropod_002", "stale")
        assert stale.reason.startswith(
            "the publisher of ropod_002_robot.level is lost: the watcher"
        )
        assert team.wait_for("ropod_001", "ok")
        assert team.wait_for("carts", "ok")
        levels["ropod_001"].record.close()
        team.wait_for("ropod_001", "error")
        assert system.wait_for("carts", "error").reason
        capsys.readouterr()
        assert main(["status", str(team.folder), "ropod_002"]) == 1
    assert "ropod_002_works" in capsys.readouterr().out


def test_watcher_publishes_as_robot_yaml_says(world: Path) -> None:
    robot = world / "ropod_001"
    url = f"ipc://{world}/statuses"
    publish = f'monitoring: {{publish: [{{url: "{url}", every: 0.05}}]}}\n'
    (robot / "robot.yaml").write_text(f"id: ropod_001\n{publish}")
    with zmq.Context() as context, context.socket(zmq.SUB) as socket:
        socket.subscribe(b"")
        socket.connect(url)
        with ExitStack() as recorder, watching(robot):
            recorder.enter_context(recording(robot))
            hear(socket, True)
            recorder.close()
            hear(socket, None)


def hear(socket: Any, alive: bool | None) -> None:
    """Receive messages until the base has the given state, or until it is unknown."""
    wanted = {
        "robotId": "ropod_001",
        "monitorName": "base_heartbeat_monitor",
        "healthStatus": {"base_alive": alive},
    }
    until = time.monotonic() + PATIENCE_S
    while time.monotonic() < until:
        if socket.poll(100) and json.loads(socket.recv()) == wanted:
            return
    raise TimeoutError(f"nothing is said of base_alive being {alive}")
