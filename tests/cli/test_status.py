"""The verb status: the present state in words, as JSON, as messages; and waiting for it."""

from __future__ import annotations

import json
import sys
import threading
import time
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from amberbox.agent.doctor.processes import SUPERVISOR_LOCK as SUPERVISED
from amberbox.blackbox.robot_folder.folder import load_folder
from amberbox.blackbox.store.store import WriterLock, create_store, open_store
from amberbox.cli.main import main
from amberbox.core.clock import NS, SystemClock
from amberbox.core.mode import Result
from amberbox.core.needs import any_of
from amberbox.core.types import Level, Output, Status
from amberbox.monitoring.current_state import write_heartbeat, write_watched_files
from amberbox.monitoring.findings import AlarmChange, Finding, record_of
from amberbox.monitoring.plan import (
    ComponentPlan,
    DependencyPlan,
    Expectation,
    MappingPlan,
    ModePlan,
    MonitoringPlan,
    OutputPlan,
)
from amberbox.testing.records import FakeRun

WORKING = OutputPlan(
    "front_laser_working", "bool", Result("working", "bool", "it is there"),
    expectation=Expectation(True), description="of the front scanner",
)  # fmt: skip
DEVICE = ModePlan("laser_device", "laser_device_monitor", None, None, [MappingPlan((), [WORKING])])
PLAN = MonitoringPlan(
    "ropod_001",
    "abc",
    (
        ComponentPlan(
            *("navigation", "navigation", (), [DependencyPlan("laser", component="laser")]),
            recovery_actions=["restart"],
        ),
        ComponentPlan("laser", "laser", (DEVICE,)),
    ),
)
GONE = "front_laser_working is false, expected true"


def statuses(
    laser: Level = "ok", outputs: Mapping[str, Output] | None = None, **navigation: Any
) -> list[Status]:
    """Return the statuses of navigation and of the laser with its mode, measured now."""
    now_ns = time.time_ns() // NS * NS
    is_ok = laser == "ok"
    state, reason = ("nominal", "") if is_ok else ("front_laser_working", GONE)
    since_ns = now_ns - 65 * NS
    of_laser = Status(
        *("ropod_001", "laser", "", laser, state, {}, (), now_ns, since_ns, reason, "abc")
    )
    upper = replace(of_laser, component="navigation", level="ok", state="nominal", reason="")
    of_mode = outputs or {"front_laser_working": is_ok}
    mode = replace(of_laser, mode="laser_device", outputs=of_mode)
    return [replace(upper, **navigation), of_laser, mode]


@pytest.fixture
def store(tmp_path: Path) -> Path:
    return tmp_path / "store"


def say(store: Path, *findings: Finding, ago_s: float = 0) -> None:
    """Write findings of a watcher with a time in the past."""
    run = FakeRun(store, "watch")
    for finding in findings:
        channel, values = record_of(finding)
        run.own(channel, time.time_ns() - round(ago_s * NS), values)
    run.journal.mark_sync().wait()


@pytest.fixture
def with_plan(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("amberbox.cli.status._plan_of", lambda where: PLAN)


def test_all_is_well(store: Path, capsys: pytest.CaptureFixture[str]) -> None:
    say(store, *statuses())
    assert main(["status", str(store)]) == 0
    assert capsys.readouterr().out.splitlines() == [
        "ropod_001: 2 ok",
        "component   level  state    for   reason",
        "navigation  ok     nominal  65 s",
        "laser       ok     nominal  65 s",
    ]


def test_tree_and_what_is_wrong(
    store: Path, with_plan: None, capsys: pytest.CaptureFixture[str]
) -> None:
    say(store, *statuses("error", blocked_by=("laser",)))
    assert main(["status", str(store)]) == 1
    assert capsys.readouterr().out.splitlines() == [
        "ropod_001: 1 error, 1 ok",
        "component   level  state                for   reason",
        "navigation  ok     nominal              65 s  blocked by laser",
        f"  laser     error  front laser working  65 s  {GONE}",
    ]


def test_documented_overview_is_what_is_shown(
    store: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    needs = {"navigation": ("localisation", "base"), "localisation": ("laser",)}
    plan = MonitoringPlan("ropod_001", "abc", [
        ComponentPlan(name, name, (), [DependencyPlan(n, component=n) for n in needs.get(name, ())])
        for name in ("navigation", "localisation", "laser", "base", "wifi")
    ])  # fmt: skip
    monkeypatch.setattr("amberbox.cli.status._plan_of", lambda where: plan)
    _, laser, _ = statuses("error")
    now_ns = laser.measured_ns
    well = replace(laser, level="ok", state="nominal", reason="", since_ns=now_ns - 7300 * NS)
    busy = replace(well, component="navigation", level="warn", state="memory")
    say(
        store,
        replace(busy, reason="memory is 812, expected < 800", since_ns=now_ns - 200 * NS),
        replace(well, component="localisation", blocked_by=("laser",)),
        replace(laser, since_ns=now_ns - 12 * NS),
        replace(well, component="base"),
        replace(well, component="wifi"),
        AlarmChange(
            *("ropod_001", "laser-20261121t140210", "laser", "urgent", "open", "error", GONE),
            *(now_ns - 12 * NS, now_ns - 12 * NS, 1, "", None, "abc"),
        ),
    )
    main(["status", str(store)])
    page = (Path(__file__).resolve().parents[2] / "docs" / "robot" / "status.md").read_text("utf-8")
    assert f"$ amberbox status ropod_001\n{capsys.readouterr().out}```" in page


def test_one_component_in_full(
    store: Path, with_plan: None, capsys: pytest.CaptureFixture[str]
) -> None:
    say(store, *statuses("error"))
    assert main(["status", str(store), "laser"]) == 1
    assert capsys.readouterr().out.splitlines()[1:] == [
        "component               level  state                for   reason",
        f"laser                   error  front laser working  65 s  {GONE}",
        f"  laser_device_monitor  error  front laser working  65 s  {GONE}",
        "",
        "output                                      value  expected  description",
        "laser_device_monitor / front_laser_working  false  true      of the front scanner",
    ]
    main(["status", str(store), "navigation"])
    assert capsys.readouterr().out.splitlines()[3:] == [
        "",
        "needs: laser (error)",
        "recovery actions: restart",
    ]


def test_what_it_needs_is_told_by_what_judges_it(
    store: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """A dependency may be written otherwise than the component, or be one of a mode's outputs."""
    needs = [
        DependencyPlan("Front Laser", component="laser"),
        DependencyPlan("scanner", "heartbeat", "laser", "laser_device", "front_laser_working"),
        DependencyPlan("scanner", "functional", "laser", "laser_device"),
        DependencyPlan("laser", "heartbeat", "laser", judged=False),
        DependencyPlan("roscore", problem="there is no component 'roscore'"),
    ]
    plan = replace(PLAN, components=(replace(PLAN.components[0], dependencies=needs),))
    monkeypatch.setattr("amberbox.cli.status._plan_of", lambda where: plan)
    say(store, *statuses("error"))
    main(["status", str(store), "navigation"])
    assert (
        "needs: Front Laser (error), scanner (error), laser (not monitored), "
        "roscore (not monitored)" in capsys.readouterr().out.splitlines()
    )


def test_what_it_can_do_without_is_told(
    store: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    edges = [DependencyPlan(name, component=name) for name in ("laser", "camera")]
    user = replace(PLAN.components[0], dependencies=edges, needs=any_of("laser", "camera"))
    plan = replace(PLAN, components=(user,))
    monkeypatch.setattr("amberbox.cli.status._plan_of", lambda where: plan)
    say(store, *statuses("error"))
    main(["status", str(store), "navigation"])
    lines = capsys.readouterr().out.splitlines()
    assert "needs laser or camera: laser (error), camera (not monitored)" in lines


def test_unknown_component_is_wrong_usage(store: Path, capsys: pytest.CaptureFixture[str]) -> None:
    say(store, *statuses())
    assert main(["status", str(store), "lasre"]) == 2
    assert "there is no component 'lasre'; did you mean 'laser'" in capsys.readouterr().err


def test_nothing_is_green_when_the_watcher_is_silent(
    store: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    say(store, *statuses(), ago_s=12)
    assert main(["status", str(store)]) == 1
    shown = capsys.readouterr()
    assert "ok" not in shown.out.split()
    assert shown.out.splitlines()[:2] == [
        "ropod_001: 2 unknown",
        "the watcher has said nothing for 12 s",
    ]
    assert shown.err == f"hint: amberbox watch {store} judges what is recorded\n"


@pytest.mark.parametrize(
    ("level", "state", "code"),
    [
        ("warn", "memory", 0),
        ("unknown", "not_monitored", 0),
        ("stale", "stale", 1),
        ("unknown", "unknown", 1),
        ("unknown", "not_initialised", 1),
    ],
)
def test_what_is_not_known_to_work_is_not_well(
    store: Path, level: Level, state: str, code: int
) -> None:
    say(store, *statuses(level=level, state=state))
    assert main(["status", str(store)]) == code
    assert main(["status", str(store), "navigation"]) == code
    assert main(["status", str(store), "laser"]) == 0, "the others do not matter"


def test_component_without_a_monitor_is_judged_by_what_it_needs(
    store: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The same for status and for --wait."""
    for waits, blocked_by, code in (("0", (), 0), ("0", ("laser",), 1)):
        say(store, *statuses(level="unknown", state="not_monitored", blocked_by=blocked_by))
        assert main(["status", str(store), "navigation"]) == code
        assert main(["status", str(store), "navigation", "--wait", waits]) == code
    told = "error: navigation: it has no monitor, and what it needs does not work: laser\n"
    assert told in capsys.readouterr().err


def test_files_that_have_changed_since_the_watcher_began_are_named(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "robot.yaml").write_text("id: r\n")
    orders = tmp_path / "orders"
    (tmp_path / "black_box.yaml").write_text(f"- sim: {{orders: {orders}}}\n")
    store = create_store(tmp_path / "store")
    say(tmp_path / "store", *statuses())
    lock = WriterLock(store, "watch")
    write_watched_files(store, load_folder(tmp_path))
    orders.write_text("fault laser_front_silent\n")  # is state, no configuration
    main(["status", str(tmp_path)])
    assert "has changed" not in capsys.readouterr().err
    (tmp_path / "components").mkdir()
    (tmp_path / "components" / "laser.yaml").write_text("component_name: laser\n")
    with (tmp_path / "robot.yaml").open("a") as file:
        file.write("model: m\n")
    main(["status", str(tmp_path)])
    said = "note: the robot folder has changed since the watcher began: "
    told = capsys.readouterr().err
    assert f"{said}components/laser.yaml (new), robot.yaml (changed)\n" in told
    assert f"note: a restart of amberbox watch {tmp_path} takes it up\n" in told
    supervisor = WriterLock(store, SUPERVISED)
    main(["status", str(tmp_path)])
    assert "amberbox run takes it up by itself" in capsys.readouterr().err
    (tmp_path / "black_box.yaml").write_text("- no_such_source: {}\n")
    main(["status", str(tmp_path)])
    assert "note: the robot folder has errors: amberbox check" in capsys.readouterr().err
    supervisor.release()
    lock.release()


def test_overloaded_monitoring_is_shown(store: Path, capsys: pytest.CaptureFixture[str]) -> None:
    say(store, *statuses())
    lock = WriterLock(open_store(store), "watch")
    write_heartbeat(open_store(store), SystemClock(), 12.4)
    assert main(["status", str(store)]) == 1
    assert "monitoring overloaded: the watcher is 12 s behind" in capsys.readouterr().out
    main(["status", str(store), "--json"])
    shown = json.loads(capsys.readouterr().out)
    assert shown["monitoring"] == {"state": "overloaded", "delay_s": 12.4}
    lock.release()


def test_store_that_was_never_watched(store: Path, capsys: pytest.CaptureFixture[str]) -> None:
    FakeRun(store).close()
    assert main(["status", str(store)]) == 1
    assert "the watcher has said nothing yet" in capsys.readouterr().out


def test_alarms_are_shown(store: Path, capsys: pytest.CaptureFixture[str]) -> None:
    found = statuses("error")
    opened_ns = found[0].measured_ns - 5 * NS
    alarm = AlarmChange(
        *("ropod_001", "laser-1", "laser", "critical", "acknowledged", "error", GONE),
        *(opened_ns, opened_ns, 3, "ada", None, "abc"),
    )
    say(store, *found, alarm)
    main(["status", str(store)])
    assert capsys.readouterr().out.splitlines()[-2:] == [
        "1 alarm:",
        f"  laser-1 (critical, acknowledged by ada, for 5 s, 3 times): {GONE}",
    ]
    say(store, replace(alarm, cause="laser#dead (likely)", diagnosis="robot-1"))
    main(["status", str(store)])
    assert capsys.readouterr().out.endswith(f": {GONE}; because of laser#dead (likely)\n")
    main(["status", str(store), "--json"])
    (shown,) = json.loads(capsys.readouterr().out)["alarms"]
    assert (shown["cause"], shown["diagnosis"]) == ("laser#dead (likely)", "robot-1")


def test_json_has_everything(store: Path, capsys: pytest.CaptureFixture[str]) -> None:
    say(store, *statuses(outputs={"front_laser_working": True, "rate": float("nan")}))
    assert main(["status", str(store), "--json"]) == 0
    shown = json.loads(capsys.readouterr().out)
    assert (shown["robot"], shown["silence"], shown["alarms"]) == ("ropod_001", "", [])
    navigation, laser = shown["components"]
    assert (navigation["component"], navigation["level"], navigation["modes"]) == (
        *("navigation", "ok"), [],
    )  # fmt: skip
    assert laser["for_s"] == 65
    assert laser["modes"][0]["outputs"] == {"front_laser_working": True, "rate": None}
    main(["status", str(store), "laser", "--json"])
    assert [c["component"] for c in json.loads(capsys.readouterr().out)["components"]] == ["laser"]


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("paper", '{"robotId":"ropod_001","monitorName":"laser_device_monitor","healthStatus":'),
        ("health_status", '"type":"HEALTH-STATUS"'),
        ("diagnostics", '"name":"laser: laser_device_monitor"'),
    ],
)
def test_messages_for_others(
    store: Path, with_plan: None, name: str, words: str, capsys: pytest.CaptureFixture[str]
) -> None:
    say(store, *statuses())
    assert main(["status", str(store), "--format", name]) == 0
    (line,) = capsys.readouterr().out.splitlines()
    assert words in line
    assert json.loads(line)


def test_messages_of_a_silent_watcher_hold_no_true(
    store: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    say(store, *statuses(), ago_s=12)
    main(["status", str(store), "--format", "health_status"])
    shown = capsys.readouterr().out
    assert '"front_laser_working":null,"status":false' in shown
    assert "true" not in shown


def test_change_of_the_folder_is_noted(
    store: Path, with_plan: None, capsys: pytest.CaptureFixture[str]
) -> None:
    say(store, *(replace(status, config_hash="older") for status in statuses()))
    assert main(["status", str(store)]) == 0
    assert "robot folder is not as it was when the watcher began" in capsys.readouterr().err


def as_terminal(monkeypatch: pytest.MonkeyPatch, columns: int = 200) -> None:
    monkeypatch.setattr(sys.stdout, "isatty", lambda: True, raising=False)
    monkeypatch.setenv("COLUMNS", str(columns))
    monkeypatch.delenv("NO_COLOR", raising=False)


def test_terminal_gets_colours_and_words(
    store: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    say(store, *statuses("error"))
    as_terminal(monkeypatch)
    main(["status", str(store)])
    shown = capsys.readouterr().out
    assert "\x1b[1;31merror\x1b[0m" in shown
    assert "\x1b[32mok\x1b[0m" in shown
    monkeypatch.setenv("NO_COLOR", "1")
    main(["status", str(store)])
    plain = capsys.readouterr().out
    assert "\x1b" not in plain
    assert "error" in plain


def test_lines_fit_the_terminal(
    store: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    say(store, *statuses("error"))
    as_terminal(monkeypatch, 60)
    monkeypatch.setenv("NO_COLOR", "1")
    main(["status", str(store)])
    lines = capsys.readouterr().out.splitlines()
    assert max(map(len, lines)) == 60
    assert lines[3].endswith("...")


def test_watch_draws_until_it_is_interrupted(
    store: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    say(store, *statuses())
    pauses: list[float] = []

    def pause(seconds: float) -> None:
        pauses.append(seconds)
        say(store, *statuses("error"))
        if len(pauses) == 2:
            raise KeyboardInterrupt

    monkeypatch.setattr("amberbox.cli.status.time.sleep", pause)
    assert main(["status", str(store), "--watch"]) == 130
    assert capsys.readouterr().out.count("ropod_001: 2 ok") == 1
    assert pauses == [1.0, 1.0]


CHAIN = f"waits for localisation (not initialised), which waits for laser: {GONE}"


def test_wait_is_over_when_the_component_is_ok(store: Path) -> None:
    say(store, *statuses("error", level="warn"))
    assert main(["status", str(store), "navigation", "--wait", "0s"]) == 0
    assert main(["status", str(store), "--wait", "0s", "navigation"]) == 0


def test_wait_names_the_chain_when_time_is_up(
    store: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    found = statuses("error", level="unknown", state="not_initialised", reason=CHAIN)
    say(store, *found)
    started = time.monotonic()
    assert main(["status", str(store), "navigation", "--wait", "0.3"]) == 1
    assert time.monotonic() - started >= 0.3
    assert capsys.readouterr().err == f"error: navigation: not initialised: {CHAIN}\n"


def test_wait_sees_what_comes_meanwhile(tmp_path: Path) -> None:
    """The start script may begin to wait before anything is recorded."""
    (tmp_path / "robot.yaml").write_text("id: ropod_001\n")
    writing = threading.Timer(0.4, lambda: say(tmp_path / "store", *statuses()))
    writing.start()
    assert main(["status", str(tmp_path), "laser", "--wait", "20s"]) == 0
    writing.join()


def test_wait_for_all(store: Path, capsys: pytest.CaptureFixture[str]) -> None:
    unmonitored = replace(statuses()[0], component="docker", level="unknown", state="not_monitored")
    say(store, *statuses(), unmonitored)
    assert main(["status", str(store), "--wait", "0"]) == 0
    say(store, *statuses("error"), unmonitored)
    assert main(["status", str(store), "--wait", "0"]) == 1
    assert capsys.readouterr().err == f"error: laser: error (front_laser_working): {GONE}\n"


def test_wait_says_that_nobody_watches(store: Path, capsys: pytest.CaptureFixture[str]) -> None:
    say(store, *statuses(), ago_s=12)
    assert main(["status", str(store), "laser", "--wait", "0"]) == 1
    shown = capsys.readouterr().err
    assert "error: laser: the watcher has said nothing for 12 s" in shown
    assert "hint: amberbox watch" in shown


def test_wait_for_what_is_in_no_file_is_wrong_usage(
    store: Path, with_plan: None, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["status", str(store), "lasre", "--wait", "9s"]) == 2
    assert "did you mean 'laser'" in capsys.readouterr().err


def test_place_that_is_no_robot_is_wrong_usage(tmp_path: Path) -> None:
    assert main(["status", str(tmp_path)]) == 2
    assert main(["status", str(tmp_path), "laser", "--wait", "9s"]) == 2
