"""The diagnosis of a team: the robot with a lost function, and that robot's own diagnosis."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path

import pytest

from amberbox.blackbox.robot_folder.folder import load_folder
from amberbox.blackbox.store.store import open_store
from amberbox.cli.diagnose import with_members
from amberbox.core.clock import NS
from amberbox.core.types import Symptom
from amberbox.diagnosis.diagnose import DiagnosisContext, ObservedSituation, diagnose_context
from amberbox.diagnosis.fmea.loader import load_fmea
from amberbox.diagnosis.knowledge import Knowledge
from amberbox.diagnosis.report.explanation import MemberDiagnosis
from amberbox.diagnosis.report.serialiser import explain_context
from amberbox.monitoring.current_state import findings_until
from tests.cli.diagnosed import Bench, write_folder

TEAM = """\
types:
  gate: {failure_modes: {shut: {probability: 0.01, symptoms: [gate/moves/opens]}}}
robots:
  first:
    where: ../first
    functions:
      drive: {probability: 0.02, severity: critical, symptoms: [first/works/works]}
  second:
    where: ../second/fmea.yaml
    functions:
      drive: {probability: 0.0001, symptoms: [first/works/works]}
"""


@pytest.fixture(scope="module")
def hot(tmp_path_factory: pytest.TempPathFactory) -> Bench:
    """Watch a robot that is well for 4 s, hot for three, and well again for 6."""
    bench = Bench(write_folder(tmp_path_factory.mktemp("team") / "first"))
    with bench.watched():
        bench.run(4)
        bench.run(3, temperature=90, speed=0)
        bench.run(6)
    bench.box.close()
    return bench


@pytest.fixture
def robot(hot: Bench, tmp_path: Path) -> Path:
    """Copy that robot's folder, to change it."""
    return Path(shutil.copytree(hot.folder, tmp_path / "first"))


def opened_ns(robot: Path) -> int:
    """Return when the robot's own diagnosis was made."""
    store = open_store(load_folder(robot).store_path)
    return findings_until(store, 1 << 62).diagnoses[0].at_ns


def said(
    robot: Path, at_ns: int, symptom: str = "first/works/works"
) -> tuple[MemberDiagnosis, ...]:
    """Return the robots' own diagnoses in a team's diagnosis of an instant."""
    team = robot.parent / "team"
    team.mkdir(exist_ok=True)
    (team / "fmea.yaml").write_text(TEAM)
    fmea, problems = load_fmea(team / "fmea.yaml")
    assert fmea is not None, problems
    knowledge = Knowledge("team", fmea)
    case = DiagnosisContext(at_ns, ObservedSituation((Symptom(symptom, "present"),)))
    told = with_members(
        knowledge, case, explain_context(knowledge, case, diagnose_context(knowledge, case))
    )
    assert told is not None
    return told.members


def test_the_robot_says_what_was_wrong_with_it_then(robot: Path) -> None:
    at_ns = opened_ns(robot) + NS
    member, *more = said(robot, at_ns)
    assert (member.name, member.where, member.state) == ("first", str(robot), "open")
    assert member.text.startswith("The bearing of the motor is worn. ")
    assert member.at_ns is not None and at_ns - 2 * NS < member.at_ns <= at_ns
    assert member.diagnosis.startswith("robot-") and member.probability is not None
    assert 0.3 < member.probability < 1
    assert member.use == "no, it cannot go on with what it does"
    assert member.next
    assert more == [], "what is not worth telling leads nowhere"


def test_robots_that_are_not_in_question_are_not_asked(robot: Path) -> None:
    assert said(robot, opened_ns(robot) + NS, "gate/moves/opens") == ()


def test_nothing_was_wrong_before_or_any_more(robot: Path) -> None:
    (before,) = said(robot, opened_ns(robot) - NS)
    assert (before.state, before.text) == ("none", "Nothing is wrong with it.")
    (after,) = said(robot, opened_ns(robot) + 7 * NS)
    assert after.state == "healed"
    assert after.text.startswith("Nothing is wrong with it. It was: the bearing of the motor")


def test_silence_is_not_taken_for_health(robot: Path) -> None:
    (late,) = said(robot, opened_ns(robot) + 60 * NS)
    assert late.state == "unknown"
    assert late.text.startswith("Nothing is known of it: its watcher has said nothing since 2023-")


@pytest.mark.parametrize(
    ("change", "why"),
    [
        (lambda robot: shutil.rmtree(robot / "store" / "watch"), "its watcher has said nothing."),
        (lambda robot: shutil.rmtree(robot / "store"), "is no store: nothing is recorded."),
        (lambda robot: shutil.rmtree(robot), "its folder cannot be read: "),
        (lambda robot: (robot / "fmea.yaml").unlink(), "it has no fmea.yaml that can be read."),
        (lambda robot: (robot / "robot.yaml").write_text("id: [\n"), "its folder cannot be read: "),
        (
            lambda robot: (robot / "robot.yaml").write_text("id: robot\nmodel: new\n"),
            "nobody watched it then with the monitors that it has now.",
        ),
    ],
    ids=["no journal", "no store", "no folder", "no fmea", "wrong folder", "other monitors"],
)
def test_why_nothing_is_known_is_told(
    robot: Path, change: Callable[[Path], object], why: str
) -> None:
    at_ns = opened_ns(robot) + NS
    change(robot)
    (member,) = said(robot, at_ns)
    assert (member.state, member.at_ns) == ("unknown", None)
    assert member.text.startswith("Nothing is known of it: ") and why in member.text
