"""``amberbox rules --where``: the facts of a robot folder and lookups in its record."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest

from amberbox.blackbox.retention.missions import MissionInstant, RecordedMission, write
from amberbox.blackbox.store.store import open_store
from amberbox.cli.main import main
from amberbox.core.clock import NS
from amberbox.core.types import Status
from amberbox.diagnosis.prolog.program import read_rules
from amberbox.monitoring.findings import HealthState, Transition, record_of
from amberbox.testing.records import T0_NS, FakeItem, FakeRun
from tests.diagnosis.prolog.swi import ask_swi, ask_us

BATTERY = FakeItem("battery", [{"charge": 1.0, "mode": "idle"}])
FMEA = """\
instances: {battery: [battery], laser: [laser]}
types:
  battery: {modes: {weak: {probability: 0.01, unobservable: nobody measures it}}}
  laser: {needs: [battery], modes: {dead: {probability: 0.01, unobservable: nobody looks}}}
findings: [{rule: failed_on_low_battery(M), maps_to: [battery#weak]}]
"""
RULES = """\
failed_on_low_battery(M) :- mission(M, failed, From, To), holds('battery.charge < 20', From, To).
"""


def mission(name: str, first: int, last: int, outcome: str) -> RecordedMission:
    """Return a mission; times are seconds of the record."""
    ended = MissionInstant(T0_NS + last * NS)
    return RecordedMission(
        name, "transport", MissionInstant(T0_NS + first * NS), parameters={"load": 5}
    ).ended(ended, outcome, failed=outcome != "done")


MISSIONS = [
    mission("m0", 0, 10, "FAILED"),  # the charge is above 20
    mission("m1", 38, 42, "failed"),  # it falls below 20 at 40.5 s
    mission("m2", 50, 60, "done"),
]


def status(level: Any, state: str, at_s: float) -> Status:
    at_ns = T0_NS + round(at_s * NS)
    return Status("rex", "laser", "", level, state, {}, (), at_ns, at_ns, "", "abc")


def change(before: tuple[Any, str], after: tuple[Any, str], at_s: float) -> Transition:
    at_ns = T0_NS + round(at_s * NS)
    return Transition(
        "rex", "laser", "", HealthState(*before), HealthState(*after), at_ns, "", (), "", "abc"
    )


@pytest.fixture(scope="module")
def robot(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Make a robot folder: two runs of 60 s, 940 s apart, the charge falling from 60 to 0.5."""
    folder = tmp_path_factory.mktemp("robot")
    for start_s in (0, 1000):
        run = FakeRun(folder / "store", items=[BATTERY])
        charges = [60 - n / 2 for n in range(120)] if start_s == 0 else [15.0, 30.0]
        run.write([
            (T0_NS + start_s * NS + n * NS // 2, BATTERY, {"charge": charge, "mode": "idle"})
            for n, charge in enumerate(charges)
        ])  # fmt: skip
        run.close()
    write(open_store(folder / "store"), MISSIONS)
    watcher = FakeRun(folder / "store", "watch")
    said: list[Status | Transition] = [
        status("ok", "nominal", 1), change(("ok", "nominal"), ("error", "alive"), 20),
        status("error", "alive", 21), change(("error", "alive"), ("error", "clear"), 30),
        change(("error", "clear"), ("ok", "nominal"), 40), status("ok", "nominal", 59),
    ]  # fmt: skip
    for finding in said:
        at_ns = finding.measured_ns if isinstance(finding, Status) else finding.at_ns
        channel, values = record_of(finding)
        watcher.own(channel, at_ns, values)
    watcher.close()
    (folder / "robot.yaml").write_text("id: rex\n")
    (folder / "black_box.yaml").write_text("- sim: {}\n")
    (folder / "fmea.yaml").write_text(FMEA)
    (folder / "rules").mkdir()
    (folder / "rules" / "low.pl").write_text(RULES)
    return folder


Answers = Sequence[dict[str, Any]]


@pytest.fixture
def asked(robot: Path, capsys: pytest.CaptureFixture[str]) -> Any:
    def ask(goal: str, *arguments: str) -> Answers:
        files = [str(robot / "rules" / "low.pl"), "--where", str(robot / "store")]
        assert main(["rules", *files, "--ask", goal, "--json", *arguments]) == 0
        found: Answers = json.loads(capsys.readouterr().out)["answers"]
        return found

    return ask


def at(seconds: float) -> int:
    return T0_NS + round(seconds * NS)


def test_which_missions_failed_while_the_battery_was_low(asked: Any) -> None:
    assert asked("failed_on_low_battery(M)") == [{"M": "m1"}]
    goal = "mission(M, failed, F, T), \\+ holds('battery.charge < 20', F, T)"
    assert [answer["M"] for answer in asked(goal)] == ["m0"]


def test_holds_at_some_time_and_throughout(asked: Any) -> None:
    low = "'battery.charge < 20'"
    first, last = {"F": at(40.5), "T": at(59.5) + 1}, {"F": at(1000), "T": at(1000.5)}
    assert asked(f"holds({low}, F, T)") == [first, last]
    assert asked(f"mission(m1, failed, F, T), holds_throughout({low}, F, T)") == []
    assert len(asked(f"mission(m2, _, F, T), holds({low}, F, T)")) == 1
    assert asked(f"holds_throughout({low}, {at(41)}, {at(59)})") == [{}]
    assert asked(f"holds({low}, {at(100)}, {at(900)})") == []  # nothing was recorded then
    assert asked("holds('battery.charge < 20 for 10s', F, T)")[0]["F"] == at(50.5)


def test_windows_cut_what_is_looked_at(asked: Any) -> None:
    window = ("--from", str(at(45)), "--to", str(at(50)))
    assert asked("holds('battery.charge < 20', F, T)", *window) == [{"F": at(45), "T": at(50)}]
    assert [answer["M"] for answer in asked("mission(M, _, _, _)", *window)] == []
    assert asked("now(T)", *window) == [{"T": at(50) - 1}]


def test_missions(asked: Any) -> None:
    assert [(a["M"], a["O"]) for a in asked("mission(M, O, _, _)")] == [
        ("m0", "FAILED"), ("m0", "failed"), ("m1", "failed"), ("m2", "done"),
    ]  # fmt: skip
    assert asked("mission_name(m0, N), mission_parameter(m0, load, L)") == [
        {"N": "transport", "L": 5}
    ]
    assert asked(f"mission(M, _, {at(39)}, {at(40)})") == [{"M": "m1"}]


def test_what_the_watcher_said_last_is_so_now(asked: Any) -> None:
    goal = "now(T), status(laser, ok, T, T)"  # it wrote last at 59 s
    assert asked(goal, "--to", str(at(60))) == [{"T": at(60) - 1}]
    assert asked(goal, "--to", str(at(70))) == []


def test_statuses_are_intervals_between_changes(asked: Any) -> None:
    assert asked("status(laser, L, F, T)") == [
        {"L": "ok", "F": at(1), "T": at(20)},
        {"L": "error", "F": at(20), "T": at(40)},
        {"L": "ok", "F": at(40), "T": at(62) + 1},  # silent for 3 s
    ]
    assert [a["S"] for a in asked("state(laser, S, From, _)")] == [
        "nominal", "alive", "clear", "nominal",
    ]  # fmt: skip
    assert asked("mission(M, failed, F, T), status(C, error, F, T)", "--from", str(at(0)))[0][
        "M"
    ] == ("m1")


def test_facts_of_the_folder(robot: Path, capsys: pytest.CaptureFixture[str]) -> None:
    goal = "robot(R), component(C), needs(C, N), part_of(C, W)"
    assert main(["rules", "--where", str(robot), "--ask", goal]) == 0
    assert capsys.readouterr().out == "R = rex, C = laser, N = battery, W = rex\n"


def test_why_names_the_item_and_the_time(robot: Path, capsys: pytest.CaptureFixture[str]) -> None:
    goal = "failed_on_low_battery(M)"
    assert main(["rules", "--where", str(robot), "--ask", goal, "--why"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[2].endswith(
        "record, mission transport, 2026-09-21T14:13:58.000Z to 2026-09-21T14:14:02.000Z"
    )
    assert lines[3].endswith(
        "record, battery, 2026-09-21T14:14:00.500Z to 2026-09-21T14:14:19.500Z"
    )


@pytest.mark.parametrize(
    ("goal", "message"),
    [
        ("holds(C, F, T)", "holds(_,_,_) would look through everything: it needs argument 1"),
        ("holds('battery.charge <', F, T)", "condition 'battery.charge <': expression, column"),
        ("holds('battery.charge', F, T)", "is no condition"),
        ("holds('batery.charge < 2', F, T)", "did you mean battery?"),
        ("holds('battery.chage < 2', F, T)", "battery has no variable 'chage'"),
        ("holds('battery.mode < 2', F, T)", "expression, column"),
        ("holds('laser/a/b', F, T)", "is no recorded variable"),
        ("holds(3, F, T)", "3 is no condition"),
        ("missionn(M, failed, F, T)", "did you mean 'mission'?"),
    ],
)
def test_what_is_refused(
    robot: Path, capsys: pytest.CaptureFixture[str], goal: str, message: str
) -> None:
    assert main(["rules", "--where", str(robot / "store"), "--ask", goal]) == 2
    assert message in capsys.readouterr().err


def test_a_long_record_is_not_looked_through_by_accident(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run = FakeRun(tmp_path / "store", items=[BATTERY])
    run.write([(at(day * 86_400), BATTERY, {"charge": 5.0, "mode": ""}) for day in range(3)])
    run.close()
    goal = ["rules", "--where", str(tmp_path / "store"), "--ask", "holds('battery.charge<9',F,T)"]
    assert main(goal) == 2
    error = capsys.readouterr().err
    assert "would look through 2.0 days of the record" in error
    assert "--from" in error
    assert main([*goal, "--from", "-2h"]) == 0
    assert f"T = {at(2 * 86_400) + 1}" in capsys.readouterr().out


def test_an_interval_is_one_over_hours_and_in_all_its_parts(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run = FakeRun(tmp_path / "store", items=[BATTERY])
    charges = [9.0] + [5.0] * 299 + [9.0]
    run.write([(at(n * 60), BATTERY, {"charge": c, "mode": ""}) for n, c in enumerate(charges)])
    run.close()
    low = "'battery.charge < 8'"
    parts = f"{at(60)}, {at(300 * 60)}), \\+ holds_throughout({low}, {at(59)}, {at(600)}"
    for goal, answer in (
        (f"holds({low}, F, T)", f"F = {at(60)}, T = {at(300 * 60)}"),
        (f"holds({low}, {at(9000)}, {at(9001)}), holds({low}, F, {at(9000)})", f"F = {at(60)}"),
        (f"holds_throughout({low}, {parts})", "yes"),
    ):
        assert main(["rules", "--where", str(tmp_path / "store"), "--ask", goal]) == 0
        assert capsys.readouterr().out == f"{answer}\n"


def test_without_a_record_nothing_is_known_of_the_past(
    robot: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for name in ("robot.yaml", "black_box.yaml", "fmea.yaml"):
        (tmp_path / name).write_text((robot / name).read_text().replace("findings", "#"))
    assert main(["rules", "--where", str(tmp_path), "--ask", "component(C)"]) == 0
    assert main(["rules", "--where", str(tmp_path), "--ask", "mission(A, B, C, D)"]) == 0
    out, err = capsys.readouterr()
    assert out.splitlines() == ["C = battery", "C = laser", "no"]
    assert "no record at" in err


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ([], "there are no rules"),
        (["a.pl", "--from", "-1h"], "--from and --to are about a record"),
        (["--where", "nowhere", "--ask", "robot(X)"], "there is nothing at nowhere"),
    ],
)
def test_wrong_usage(
    arguments: list[str], message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["rules", *arguments]) == 2
    assert message in capsys.readouterr().err


def test_swi_prolog_answers_the_same_of_the_export(robot: Path, tmp_path: Path) -> None:
    target = tmp_path / "all.pl"
    goals = ["failed_on_low_battery(M)", "status(C, S, F, T)", "holds('battery.charge < 20', F, T)",
             "mission(M, failed, F, T), status(C, error, F, T)", "needs(A, B)", "now(N)",
             "mission_parameter(M, K, V)", "probability(C, M, P)"]  # fmt: skip
    arguments = ["rules", "--where", str(robot), "--export", str(target)]
    assert main(arguments) == 0
    exported = read_rules([target])
    swi = ask_swi(tmp_path, target.read_text(), goals)
    assert swi == list(ask_us(exported, goals))
    assert all(swi)
