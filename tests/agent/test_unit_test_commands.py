"""Unit tests that the command process announces, and runs on signed commands."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from threading import Thread
from typing import Any

import msgspec
import pytest

from amberbox.agent.command_socket import Announcement, Answers, Challenge, FromGate, SiteConfirms
from amberbox.agent.unit_test_action import load_unit_test
from amberbox.agent.unit_tests import Progress, UnitTestRun, collect
from amberbox.cli.action import ActionPort
from amberbox.core.errors import UsageError
from amberbox.experiments.local import ActionOutcome
from amberbox.link.folders import pack, unpack
from amberbox.link.frames import LeaseFrame
from tests.agent.test_act import ROBOT_YAML, TRUST, Act, Linked
from tests.support.processes import wait_for
from tests.support.unit_tests import FinishedRun, run_tests, write_tests
from tests.support.zmq_robot import ACTIONS, ZmqRobot, zmq_robot

TESTS = """
@pytest.mark.tests("lamp#dark")
def test_reads(measure):
    \"\"\"It reads.\"\"\"
    measure("length", 2.5, "m")
    print("x" * 100_000)
def test_fails(): assert 1 == 2, "too short"
@pytest.mark.risk("moves")
def test_drives(act): act("drive", distance_m=1)
"""


@pytest.fixture
def robot() -> Iterator[ZmqRobot]:
    with zmq_robot() as found:
        yield found


@pytest.fixture
def folder(tmp_path: Path, robot: ZmqRobot) -> Path:
    found = write_tests(tmp_path / "robot", a=TESTS)
    (found / "actions").mkdir()
    (found / "actions" / "all.yaml").write_text(ACTIONS.replace("ENDPOINT", robot.endpoint))
    trust = tmp_path / "trust.yaml"
    trust.write_text(TRUST)
    trust.chmod(0o600)
    (found / "robot.yaml").write_text(ROBOT_YAML.replace("TRUST", str(trust)))
    return found


@pytest.fixture
def act(folder: Path) -> Iterator[Act]:
    found = Act(folder)
    yield found
    found.process.terminate()
    assert found.process.wait(60) == 0


def announced(link: Linked, count: int) -> list[dict[str, Any]]:
    """Wait until so many tests are announced; return them."""

    def fits(report: FromGate) -> bool:
        return isinstance(report, Announcement) and len(announced_in(report)) == count

    report = link.wait(fits)
    assert isinstance(report, Announcement)
    return announced_in(report)


def announced_in(report: Announcement) -> list[dict[str, Any]]:
    found: list[dict[str, Any]] = msgspec.json.decode(report.actions)["tests"]
    return found


def taken_anew(link: Linked, at: Challenge, run: str) -> Challenge:
    """Give the lease back, and take it for another run."""
    link.send(LeaseFrame("release", "anna", at.lease.run, at.lease.number))
    return link.take(run)


def result_of(link: Linked, test: str, at: Challenge) -> dict[str, Any]:
    """Order a test and wait until it is done; return its result."""
    command = link.order(test, at=at)
    link.done(command, at)
    answers = [a for one in link.reports if isinstance(one, Answers) for a in one.answers]
    (text,) = [a.result for a in answers if a.id == command and a.state == "done"]
    found: dict[str, Any] = msgspec.json.decode(text)
    return found


def test_tests_are_announced_and_run_on_command(act: Act, folder: Path) -> None:
    link = Linked(act.store)
    assert announced(link, 3)[0] == {
        "name": "a.reads", "description": "It reads.", "risk": "state", "timeout_s": 30.0,
        "about": ["lamp#dark"],
    }  # fmt: skip
    at = link.take()
    result = result_of(link, "test.a.reads", at)
    assert (result["name"], result["outcome"]) == ("a.reads", "passed")
    assert result["measurements"] == [{"name": "length", "value": 2.5, "unit": "m"}]
    assert result["left_out_bytes"] > 90_000
    at = taken_anew(link, at, "run-2")
    assert result_of(link, "test.a.fails", at)["outcome"] == "failed"
    write_tests(folder, a=TESTS, b="def test_b(): pass")
    assert announced(link, 4)[-1]["name"] == "b.b"


def test_what_is_not_granted_is_refused(act: Act, robot: ZmqRobot) -> None:
    link = Linked(act.store)
    announced(link, 3)
    at = link.take()
    assert "test.a.nowhere" in link.answer(link.order("test.a.nowhere", at=at), "refused")
    at = taken_anew(link, at, "run-2")
    given = link.order("test.a.reads", '{"x": 1}', at=at)
    assert "there is no parameter 'x'" in link.answer(given, "refused")
    at = taken_anew(link, at, "run-3")
    as_state = link.order("test.a.drives", risk="state", at=at)
    assert "moves" in link.answer(as_state, "refused")
    assert not robot.hears


def test_a_test_that_moves_is_confirmed_and_ends_with_its_lease(
    act: Act,
    robot: ZmqRobot,
) -> None:
    link = Linked(act.store)
    announced(link, 3)
    at = link.take()
    command = link.order("test.a.drives", risk="moves", at=at)
    link.renew_until(at.lease.number, lambda: act.state().waiting)
    assert not robot.hears
    act.site().ask(SiteConfirms(on_site=True))
    link.renew_until(at.lease.number, lambda: robot.heard("linear"))
    robot.wait_until("stop")  # nobody renews
    assert "lease" in link.answer(command, "aborted")


def test_tests_that_changed_are_not_run_as_announced(folder: Path) -> None:
    (folder / "store").mkdir()
    collect(folder)
    assert load_unit_test(folder, "test.a.drives").options.risk == "moves"
    (folder / "tests" / "test_a.py").write_text("def test_drives(): pass\n")
    with pytest.raises(UsageError, match="have changed"):
        load_unit_test(folder, "test.a.drives")


def test_their_code_stays_on_the_robot() -> None:
    names = {"tests/test_a.py": b"x = 1", "tests/conftest.py": b"", "robot.yaml": b"id: r1\n"}
    assert set(unpack(pack(names))) == {"robot.yaml"}


def test_a_test_by_hand_orders_its_actions_from_the_command_process(
    act: Act, folder: Path, robot: ZmqRobot
) -> None:
    """Another run that holds the robot is not disturbed; when it is free, the order is seen."""
    link = Linked(act.store)
    at = link.take()
    done: list[FinishedRun] = []
    by_hand = Thread(target=lambda: done.append(run_tests(folder, names=("a.drives",))))
    by_hand.start()
    link.renew_until(at.lease.number, lambda: not by_hand.is_alive())
    assert "held by anna (run run-1)" in done[0].results["a.drives"].message
    assert not robot.hears
    link.send(LeaseFrame("release", "anna", "run-1", at.lease.number))
    wait_for(lambda: not act.state().lease.holder, "the end of the lease")
    people: list[str] = []

    def abort_what_runs(run: UnitTestRun, progress: Progress) -> None:
        if progress.text == "drive":
            wait_for(lambda: act.state().running and robot.heard("linear"), "the motion")
            people.extend(one.person for one in act.state().running)
            run.abort("seen enough")

    run_tests(folder, abort_what_runs, names=("a.drives",))
    assert people == ["unit test a.drives"]
    assert robot.heard("stop") and not act.state().running


def test_an_experiment_at_the_robot_can_have_a_unit_test(act: Act, folder: Path) -> None:
    announced(Linked(act.store), 3)
    port = ActionPort(folder)
    assert port.moves("test.a.drives") and not port.moves("test.a.reads")
    begun = port.begin("test.a.reads", "{}", None, lambda text: None)

    def outcome() -> ActionOutcome | None:
        begun.renew()
        return begun.wait(0.2)

    found = wait_for(outcome, "the outcome of the test")
    assert found.state == "done" and json.loads(found.result)["outcome"] == "passed"
    with pytest.raises(UsageError, match=r"has no .test\.a\.nowhere"):
        port.begin("test.a.nowhere", "{}", None, lambda text: None)
