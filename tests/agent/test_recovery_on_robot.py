"""Recovery of the simulated robot: by a rule until it gives up, then by hand."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from amberbox.agent.recovery import RuleReport, read_recovery
from amberbox.blackbox.journal import channels
from amberbox.blackbox.store.own_records import OwnRecords
from amberbox.blackbox.store.store import Store, is_store, open_store
from amberbox.cli.main import main
from amberbox.core.clock import SystemClock
from amberbox.monitoring.current_state import CurrentStateReader
from amberbox.testing.clock import PATIENCE_S, wait_until

RULE = """\
recovery:
  - when: laser_front/process
    do: restart_process
    with: {process: laser_front}
    at_most: 1 per 1 h
    wait: 1 s
    if: sim_battery.percentage > 0.05
"""
COMPONENT = """\
component_name: laser_front
modes: [laser_front/process.yaml]
recovery_actions: [restart_process process=laser_front]
"""
TOPICS = "[{name: nodes}, {name: battery}]"


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    found = tmp_path / "robot"
    assert main(["new", str(found), "--from", "sim"]) == 0
    address = f"ipc://{tmp_path}/sim.sock"
    actions = found / "actions" / "sim.yaml"
    actions.write_text(actions.read_text().replace("tcp://127.0.0.1:5557", address))
    (found / "black_box.yaml").write_text(
        f"- sim: {{seed: 7, orders: {tmp_path}/orders, commands: '{address}', topics: {TOPICS}}}\n"
    )
    # one monitor of many, so that the watcher keeps up on any machine
    for name in ("fmea.yaml", "rules", "components"):
        (found / name).rename(tmp_path / name)
    (found / "components" / "laser_front").mkdir(parents=True)
    (found / "components" / "laser_front.yaml").write_text(COMPONENT)
    process = "laser_front/process.yaml"
    (tmp_path / "components" / process).rename(found / "components" / process)
    with (found / "robot.yaml").open("a") as file:
        file.write(RULE)
    assert main(["check", str(found)]) == 0
    return found


@pytest.fixture
def store(folder: Path) -> Iterator[Store]:
    box = subprocess.Popen([sys.executable, "-m", "amberbox", "run", "--quiet", str(folder)])
    try:
        wait_until(lambda: is_store(folder / "store"))
        found = open_store(folder / "store")
        wait_until(lambda: read_recovery(found), "rules that are followed")
        wait_until(lambda: is_well(found), "a laser that is well")
        yield found
    finally:
        box.terminate()
        assert box.wait(PATIENCE_S) == 0


def is_well(store: Store) -> bool:
    statuses = CurrentStateReader(store).read(SystemClock().wall_ns()).modes_of("laser_front")
    return any(status.mode == "process" and status.level == "ok" for status in statuses)


def crash(folder: Path, store: Store) -> None:
    with (folder.parent / "orders").open("a") as file:
        file.write("fault laser_front_driver_crash\n")
    wait_until(lambda: not is_well(store), "a laser that has crashed")


def rule(store: Store) -> RuleReport:
    return read_recovery(store)[0]


def test_a_crashed_process_is_restarted_until_the_limit(
    folder: Path, store: Store, capfd: pytest.CaptureFixture[str]
) -> None:
    crash(folder, store)
    wait_until(lambda: rule(store).attempts == 1, "an attempt")
    wait_until(lambda: is_well(store) and rule(store).state == "idle", "a laser that is well again")
    crash(folder, store)
    wait_until(lambda: rule(store).state == "gave_up", "the end of the attempts")
    assert rule(store).attempts == 1 and not is_well(store)
    records = [record.values for record in OwnRecords(store, "act", {channels.COMMAND}).step()]
    orders = [values for values in records if values["state"] == "run"]
    assert [(one["action"], one["issuer"]) for one in orders] == [("restart_process", "policy")]
    ends = [values["state"] for values in records if values.get("id") == orders[0]["id"]]
    assert ends == ["accepted", "run", "done"]
    capfd.readouterr()
    assert main(["status", str(folder), "laser_front"]) == 1
    shown = capfd.readouterr().out
    assert "gave up" in shown
    line = next(row for row in shown.splitlines() if row.startswith("by hand: "))
    words = line.removeprefix("by hand: amberbox ").split()
    assert main(words) == 0
    wait_until(lambda: is_well(store), "a laser that was restarted by hand")

    def has_event() -> bool:
        main(["events", str(folder)])
        return "recovery_gave_up" in capfd.readouterr().out

    wait_until(has_event, "the event that it gave up")
