"""Fixtures of unit tests on the record of a simulated robot, live, and on one that has ended."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path

import pytest

from amberbox.cli.main import main
from amberbox.client.opening import open as open_record
from tests.support.processes import free_port, running, wait_for
from tests.support.unit_tests import FinishedRun, run_tests, write_tests


@pytest.fixture(scope="module")
def live(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """Run the whole box on a new simulated robot that obeys, until its lasers are monitored."""
    folder = tmp_path_factory.mktemp("live") / "robot"
    assert main(["new", str(folder)]) == 0
    address = f"tcp://127.0.0.1:{free_port()}"
    for path, line in (
        (folder / "black_box.yaml", "    # commands: tcp://127.0.0.1:5557"),
        (folder / "actions" / "sim.yaml", "tcp://127.0.0.1:5557"),
    ):
        text = path.read_text()
        assert line in text
        new = f"    commands: {address}" if line.startswith(" ") else address
        path.write_text(text.replace(line, new))

    def lasers_are_monitored() -> bool:
        return main(["status", str(folder), "laser_front", "--wait", "1s"]) == 0

    with running("run", folder, log=folder.parent / "log"):
        wait_for(lasers_are_monitored, "the lasers")
        yield folder


@pytest.fixture(scope="module")
def ended(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a robot whose record has ended: 20 s of a simulated one."""
    folder = tmp_path_factory.mktemp("ended") / "robot"
    folder.mkdir()
    (folder / "robot.yaml").write_text("id: r1\n")
    (folder / "black_box.yaml").write_text("- sim: {speed: max, duration_s: 20, seed: 3}\n")
    assert main(["record", str(folder), "--quiet"]) == 0
    return folder


def run_of(folder: Path, text: str) -> FinishedRun:
    """Run tests in place of those that the folder has."""
    for path in (folder / "tests").glob("*.py"):
        path.unlink()
    kept = (folder / "black_box.yaml").read_text()
    write_tests(folder, t=text)
    (folder / "black_box.yaml").write_text(kept)
    return run_tests(folder)


def test_the_sample_tests_pass_on_the_simulated_robot(
    live: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """With ``amberbox new`` and ``run`` alone; its driving is measured, and its window kept."""
    assert main(["test", str(live), "--yes", "--json"]) == 0, capsys.readouterr().out
    results = {one["name"]: one for one in json.loads(capsys.readouterr().out)["results"]}
    assert len(results) == 8
    assert {one["outcome"] for one in results.values()} == {"passed"}
    driven = results["driving.drives_half_a_metre"]
    assert driven["measurements"][0]["value"] == pytest.approx(0.5, abs=0.05)
    (kept,) = driven["recordings"]
    assert driven["began"] < kept["from"] < kept["to"] < driven["ended"]
    with open_record(live) as record:
        assert record.incident_windows(kept["incident"])
        rows = record.query("sim_odom", ["twist_linear_x"], kept["from"], kept["to"])
    assert max(rows.values("twist_linear_x")) == pytest.approx(0.25, abs=0.05)


def test_live_conditions_and_statuses(live: Path) -> None:
    done = run_of(live, """
        def test_waits(wait_for): wait_for("count(sim_imu.header_seq over 1s) > 50", 20)
        def test_status_in_a_condition(wait_for):
            wait_for('status(laser_front) == "ok" and sim_battery.voltage > 20', within_s=20)
        def test_goes_on(variable):
            stamp = variable("sim_odom.header/seq")
            before = stamp.value
            assert stamp.wait_for(f"> {before + 20}", within_s=20).value > before + 20
        def test_lists(variable): assert 0 < variable("sim_scan_front.ranges[3]").value < 30
        def test_never(wait_for): wait_for("sim_battery.voltage < 0", within_s=0.3)
        def test_text(wait_for): wait_for('sim_battery.voltage == "x"', within_s=5)
        def test_none(wait_for): wait_for("sim_battery.voltage", within_s=5)
        def test_status(status):
            found = status("laser_front")
            assert (found.level, found.state) == ("ok", "nominal")
        def test_unknown_component(status): status("laser_frnt")
        def test_keeps_although_it_dies(recording):
            with recording("until it ended"):
                os._exit(3)
    """)  # fmt: skip
    messages = {name: result.message for name, result in done.results.items()}
    good = ("t.waits", "t.status_in_a_condition", "t.goes_on", "t.lists", "t.status")
    assert {name: messages[name] for name in good} == dict.fromkeys(good, "")
    assert (
        "not within 0.3 s: sim_battery.voltage < 0 (sim_battery.voltage is" in messages["t.never"]
    )
    assert "cannot be evaluated" in messages["t.text"]
    assert "is no condition" in messages["t.none"]
    assert "did you mean 'laser_front'?" in messages["t.unknown_component"]
    died = done.results["t.keeps_although_it_dies"]
    assert died.outcome == "killed"
    assert [one.reason for one in died.recordings] == ["until it ended"]


def test_a_record_that_has_ended(ended: Path) -> None:
    """What is recorded can be asked; what is said of now is not taken from it."""
    done = run_of(ended, """
        def test_reads(record, variable, robot):
            assert robot.id == "r1" and not robot.simulated
            table = record.query("sim_battery", ["voltage"])
            assert variable("sim_battery.voltage").value == table.values("voltage")[-1]
            assert len(variable("sim_battery.voltage").last(2)) >= 3
        def test_waits(wait_for): wait_for("sim_battery.voltage > 0", within_s=30)
        def test_status(status):
            found = status("laser_front")
            assert (found.level, found.state) == ("unknown", "unknown") and found.reason
        def test_item(variable): variable("sim_batery.voltage").value
        def test_address(variable): variable("voltage")
        def test_measures(measure): measure("x", object())
    """)  # fmt: skip
    messages = {name: result.message for name, result in done.results.items()}
    assert messages["t.reads"] == "" and messages["t.status"] == ""
    assert "no recorder runs" in messages["t.waits"]
    assert "sim_batery" in messages["t.item"]
    assert "is no address of a variable" in messages["t.address"]
    assert "only a number, a text or a bool" in messages["t.measures"]
