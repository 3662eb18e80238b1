"""One run of an experiment: forms, errors, timers, pauses, ends, restarts, and what stops it."""

from __future__ import annotations

import builtins
import json
from typing import Any

import pytest

from amberbox.core.errors import UsageError
from amberbox.core.expression import parse
from amberbox.experiments.action import ParameterOptions
from amberbox.experiments.experiment import ExperimentOptions, FieldOptions, RobotStepOptions
from amberbox.experiments.procedure import Procedure
from amberbox.experiments.run import ExperimentRun, element_states
from amberbox.experiments.workflow import Process
from tests.experiments.procedures import (
    PASS_FAIL,
    S,
    catch,
    node,
    procedure,
    process,
    timer,
)


def begun(of: Procedure | Process, **parameters: Any) -> ExperimentRun:
    of = of if isinstance(of, Procedure) else procedure(of)
    return ExperimentRun.begin(of, "r1", "robo", parameters, {"operator": "ada"}, 0)


def drive(run: ExperimentRun, path: str, at_s: float = 0.0) -> str:
    """Start the step of a path; return its id."""
    task = next(task for task in run.robot_tasks() if task.step.path == path)
    run.robot_started(task.id, f"c-{task.id}", int(at_s * S))
    return task.id


def answered(run: ExperimentRun, path: str, at_s: float = 0.0, **values: Any) -> None:
    task = next(task for task in run.person_tasks() if task.step.path == path)
    run.complete(task.id, values, "ada", int(at_s * S))


def waiting(run: ExperimentRun) -> list[str]:
    people = [task.step.path for task in run.person_tasks()]
    return sorted(people + [task.step.path for task in run.robot_tasks()])


DRIVE_AND_RECOVER = process(
    node("start", "start", "drive"),
    node(
        "drive",
        "robot",
        "end",
        boundaries=(timer("too_long", 20, "recover"), catch("trouble", "robot_error", "recover")),
    ),
    node("recover", "person", "bad"),
    node("bad", "error_end", code="test_failed"),
    node("end", "end"),
)
FAILS = {"drive": RobotStepOptions(action="drive", errors={"failed": "robot_error"})}


def test_a_run_that_goes_through_has_passed_and_lists_everything_in_order() -> None:
    run = begun(DRIVE_AND_RECOVER)
    task = drive(run, "drive", 1)
    run.robot_report(task, "half\nway", 2 * S)
    run.robot_ended(task, "done", 3 * S)
    assert (run.outcome, list(run.reasons)) == ("passed", ["end"])
    assert [(e.number, e.at_ns // S, e.kind, e.element) for e in run.events] == [
        (1, 0, "begun", ""),
        (2, 0, "passed", "start"),
        (3, 0, "ready", "drive"),
        (4, 1, "started", "drive"),
        (5, 2, "report", "drive"),
        (6, 3, "ended", "drive"),
        (7, 3, "passed", "end"),
        (8, 3, "over", ""),
    ]
    assert run.events[4].text == "half way"


def test_an_error_of_one_robot_step_leaves_another_with_the_same_code_alone() -> None:
    run = begun(
        process(
            node("start", "start", "fork"),
            node("fork", "parallel", "one", "two"),
            node("one", "robot", "end", boundaries=(catch("one_error", "e", "help_one"),)),
            node("two", "robot", "end", boundaries=(catch("two_error", "e", "help_two"),)),
            node("help_one", "person", "end"),
            node("help_two", "person", "end"),
            node("end", "end"),
        )
    )
    one, two = drive(run, "one"), drive(run, "two")
    run.robot_ended(one, "failed", S)
    assert run.outcome == "failed", "its code is another one: nothing catches it"

    robot = {p: RobotStepOptions(action="go", errors={"failed": "e"}) for p in ("one", "two")}
    run = begun(procedure(run.procedure.process, robot=robot))
    one, two = drive(run, "one"), drive(run, "two")
    run.robot_ended(one, "failed", S)
    assert waiting(run) == ["help_one"]
    assert [task.id for task in run.running()] == [two]
    assert run.stop_orders() == []


@pytest.mark.parametrize("state", ["failed", "outcome_unknown"])
def test_an_error_goes_outwards_to_the_activity_that_catches_it(state: Any) -> None:
    inner = process(
        node("i_start", "start", "i_fork"),
        node("i_fork", "parallel", "go", "look"),
        node("go", "robot", "i_end", boundaries=(catch("other", "another_code", "i_end"),)),
        node("look", "person", "i_end"),
        node("i_end", "end"),
    )
    middle = process(
        node("m_start", "start", "in"), node("in", "inner", "m_end", inner=inner),
        node("m_end", "end"),
    )  # fmt: skip
    run = begun(
        process(
            node("start", "start", "out"),
            node("out", "inner", "end", inner=middle, boundaries=(catch("c", "", "help"),)),
            node("help", "person", "end"),
            node("end", "end"),
        )
    )
    run.robot_ended(drive(run, "go"), state, S)
    assert waiting(run) == ["help"], "what else went on in the sub-process is interrupted"
    states = element_states(run.procedure, run.events)
    assert (states["out"], states["in"], states["go"]) == ("failed", "failed", "failed")
    assert (states["c"], states["help"]) == ("done", "current")
    answered(run, "help")
    assert run.outcome == "passed"


def test_a_timer_interrupts_and_the_action_is_stopped_before_the_next_begins() -> None:
    run = begun(
        process(
            node("start", "start", "drive"),
            node("drive", "robot", "end", boundaries=(timer("late", 20, "back"),)),
            node("back", "robot", "end"),
            node("end", "end"),
        )
    )
    assert run.next_due_ns == 20 * S
    task = drive(run, "drive", 19)
    run.tick(20 * S - 1)
    assert [t.id for t in run.running()] == [task]
    run.tick(20 * S)
    (order,) = run.stop_orders()
    assert (order.task, order.command) == (task, f"c-{task}")
    assert run.robot_tasks() == [], "the first action has not been stopped yet"
    run.robot_ended(task, "aborted", 21 * S)
    assert waiting(run) == ["back"]
    assert run.next_due_ns is None


def test_a_timer_that_does_not_interrupt_starts_a_branch_beside_its_activity() -> None:
    run = begun(
        process(
            node("start", "start", "drive"),
            node(
                "drive",
                "robot",
                "end",
                boundaries=(timer("slow", 5, "seen", interrupts=False),),
            ),
            node("seen", "person", "noted"),
            node("noted", "end"),
            node("end", "end"),
        )
    )
    task = drive(run, "drive")
    run.tick(100 * S)
    assert [t.id for t in run.running()] == [task]
    run.robot_ended(task, "done", 100 * S)
    assert run.outcome is None, "the branch beside it has not ended"
    answered(run, "seen")
    assert run.outcome == "passed"


def test_timers_stand_still_and_the_robot_begins_nothing_during_a_pause() -> None:
    run = begun(DRIVE_AND_RECOVER)
    run.pause("ada", "lunch", 5 * S)
    run.tick(1000 * S)
    assert (run.is_paused, run.robot_tasks(), run.next_due_ns) == (True, [], None)
    run.resume("ada", "", 1005 * S)
    assert run.next_due_ns == 1020 * S
    run.tick(1019 * S)
    assert waiting(run) == ["drive"]
    run.tick(1020 * S)
    assert waiting(run) == ["recover"]


def test_an_action_that_was_started_is_not_offered_again_and_its_end_counts_once() -> None:
    run = begun(procedure(DRIVE_AND_RECOVER, robot=FAILS))
    task = drive(run, "drive")
    run = ExperimentRun.restore(run.procedure, run.state())
    assert run.robot_tasks() == []
    run.robot_started(task, f"c-{task}", S)  # the same command again is the same start
    with pytest.raises(UsageError, match="cannot begin now"):
        run.robot_started(task, "another", S)
    run.robot_ended(task, "failed", 2 * S, "stuck")
    run.robot_ended(task, "failed", 3 * S, "stuck")
    count = len(run.events)
    run.robot_ended(task, "done", 3 * S)
    assert [e.kind for e in run.events[count:]] == ["late"]
    assert waiting(run) == ["recover"]
    with pytest.raises(UsageError, match="there is no step"):
        run.robot_ended("drive.7", "done", 3 * S)


def test_a_robot_that_nobody_knows_of_goes_the_way_of_its_error() -> None:
    robot = {"drive": RobotStepOptions("drive", errors={"outcome_unknown": "robot_error"})}
    run = begun(procedure(DRIVE_AND_RECOVER, robot=robot))
    run.robot_ended(drive(run, "drive"), "outcome_unknown", S)
    assert waiting(run) == ["recover"]
    answered(run, "recover")
    assert (run.outcome, list(run.reasons)) == ("failed", ["bad"])


def test_an_error_that_nothing_catches_fails_the_run_and_stops_the_other_actions() -> None:
    run = begun(
        process(
            node("start", "start", "fork"),
            node("fork", "parallel", "one", "two", "look"),
            node("one", "robot", "end"),
            node("two", "robot", "end"),
            node("look", "person", "end"),
            node("end", "end"),
        )
    )
    one, two = drive(run, "one"), drive(run, "two")
    run.robot_ended(one, "refused", S, "no lease")
    assert run.outcome == "failed"
    assert "no lease (nothing catches 'action_refused')" in run.reasons[0]
    assert [order.task for order in run.stop_orders()] == [two]
    assert not run.is_closed and not run.person_tasks()
    run.robot_ended(two, "aborted", 2 * S)
    assert run.is_closed


def test_an_abort_counts_once_and_ignores_timers_that_are_due() -> None:
    run = begun(DRIVE_AND_RECOVER)
    task = drive(run, "drive")
    run.abort("eve", "a person came in", 100 * S)
    run.abort("ada", "again", 101 * S)
    assert (run.outcome, list(run.reasons)) == ("aborted", ["aborted by eve: a person came in"])
    assert [order.task for order in run.stop_orders()] == [task]
    with pytest.raises(UsageError, match="does not wait"):
        run.complete("recover.1", {}, "ada", 102 * S)


def test_what_a_person_enters_is_judged_field_by_field() -> None:
    fields = {
        "ok": PASS_FAIL,
        "seen": FieldOptions(kind="confirm"),
        "volts": FieldOptions(kind="number", label="Voltage", unit="V", min=0, max=60),
        "where": FieldOptions(kind="choice", choices=("left", "right")),
        "why": FieldOptions(kind="text", required=False),
    }
    of = process(
        node("start", "start", "ask"), node("ask", "person", "end"), node("end", "end")
    )  # fmt: skip
    run = begun(procedure(of, {"ask": fields}))
    wrong: dict[str, Any] = {
        "ok": 1,
        "seen": False,
        "volts": float("nan"),
        "where": "up",
        "why": 3,
        "whi": "",
    }
    with pytest.raises(UsageError) as caught:
        answered(run, "ask", **wrong)
    for text in (
        "no field 'whi'; did you mean 'why'?", "ok: is neither pass", "seen: is not confirmed",
        "Voltage: is too large, or no number", "where: is none of left, right", "why: is no text",
    ):  # fmt: skip
        assert text in caught.value.what
    with pytest.raises(UsageError, match="ok: is missing; seen: is missing"):
        answered(run, "ask")
    assert waiting(run) == ["ask"]
    answered(run, "ask", ok=None, seen=True, volts=24, where="left", why="a\x1b[31m")
    assert run.events[3].values["why"] == "a\\u001b[31m"
    assert run.outcome == "passed"
    assert run.events[-1].values["skipped"] == ["ask, ok"]


def test_a_step_that_failed_fails_the_run_unless_it_was_done_again_or_its_end_says_so() -> None:
    of = process(
        node("start", "start", "ask"),
        node("ask", "person", "again"),
        node("again", "exclusive", ("ask", "not ok"), "end"),
        node("end", "end"),
    )
    once = process(
        node("start", "start", "ask"), node("ask", "person", "end"), node("end", "end")
    )  # fmt: skip
    run = begun(procedure(of, {"ask": {"ok": PASS_FAIL}}))
    answered(run, "ask", ok=False)
    answered(run, "ask", ok=True)
    assert run.outcome == "passed"
    run = begun(procedure(once, {"ask": {"ok": PASS_FAIL}}))
    answered(run, "ask", ok=False)
    assert (run.outcome, list(run.reasons)) == ("failed", ["ask, ok: fail"])
    options = ExperimentOptions(ends={"end": "aborted"})
    run = begun(procedure(once, {"ask": {"ok": PASS_FAIL}}, options=options))
    answered(run, "ask", ok=False)
    assert (run.outcome, list(run.reasons)) == ("aborted", ["end"])


def test_parameters_are_judged_evaluated_and_handed_to_the_robot() -> None:
    options = ExperimentOptions(parameters={"far_m": ParameterOptions(type="float", max=5)})
    robot = {
        "drive": RobotStepOptions(
            "drive", parameters={"distance_m": "= far_m / 2", "side": "left"},
            results={"moved_m": "odometry.moved", "odd": "odometry"},
        )
    }  # fmt: skip
    of = procedure(
        process(
            node("start", "start", "drive"), node("drive", "robot", "g"),
            node("g", "exclusive", ("end", "moved_m > 1.9"), "bad"),
            node("bad", "error_end"), node("end", "end"),
        ),
        robot=robot, options=options,
    )  # fmt: skip
    with pytest.raises(UsageError, match="above the largest value, 5"):
        begun(of, far_m=6)
    run = begun(of, far_m=4)
    assert run.robot_tasks()[0].parameters == {"distance_m": 2.0, "side": "left"}
    run.robot_ended(drive(run, "drive"), "done", S, "", {"odometry": {"moved": 1.95}})
    assert run.outcome == "passed"
    assert dict(run.variables) == {"far_m": 4.0, "moved_m": 1.95, "odd": None}
    passed = next(e for e in run.events if e.element == "g")
    assert passed.values == {"flow": "g-end", "read": {"moved_m": 1.95}}


@pytest.mark.parametrize(
    ("condition", "what"),
    [
        ("path_clear", "the variable 'path_clear' has no value yet"),
        ("1 < 0", "no condition of the flows that leave 'g' is true"),
        ("1 + 1", "'1 + 1' is no condition"),
    ],
)
def test_a_gateway_that_cannot_decide_ends_the_run_and_the_robot_does_nothing(
    condition: str, what: str
) -> None:
    gateway = node("g", "exclusive", ("drive", condition))
    of = process(
        node("start", "start", "fork"), node("fork", "parallel", "g", "other"), gateway,
        node("other", "robot", "end"), node("drive", "robot", "end"), node("end", "end"),
    )  # fmt: skip
    run = begun(of)
    assert run.outcome == "error"
    assert what in run.reasons[0]
    assert run.events[-1].element == "g"
    assert not run.robot_tasks() and run.is_closed
    assert ExperimentRun.restore(run.procedure, run.state()).outcome == "error"


def test_null_is_not_true() -> None:
    run = begun(
        procedure(
            process(
                node("start", "start", "ask"),
                node("ask", "person", "g"),
                node("g", "exclusive", ("drive", "ok"), "end"),
                node("drive", "robot", "end"),
                node("end", "end"),
            ),
            {"ask": {"ok": PASS_FAIL}},
        )
    )
    answered(run, "ask", ok=None)
    assert run.outcome == "passed" and not run.robot_tasks()


def test_a_parameter_without_a_value_ends_the_run_before_the_robot_does_anything() -> None:
    robot = {"drive": RobotStepOptions("drive", parameters={"distance_m": "=far_m"})}
    run = begun(procedure(DRIVE_AND_RECOVER, robot=robot))
    assert (run.outcome, run.robot_tasks()) == ("error", [])
    assert "distance_m: the variable 'far_m' has no value yet" in run.reasons[0]


def test_live_values_are_asked_for_by_address_and_kept_with_the_decision() -> None:
    of = process(
        node("start", "start", "g"),
        node("g", "exclusive", ("drive", "battery.volts > 20"), "end"),
        node("drive", "robot", "end"),
        node("end", "end"),
    )
    values = {"battery.volts": 24.0}
    run = ExperimentRun.begin(procedure(of), "r", "robo", {}, {}, 0, live=values.get)
    assert waiting(run) == ["drive"]
    assert run.events[2].values["read"] == {"battery.volts": 24.0}
    run = ExperimentRun.begin(procedure(of), "r", "robo", {}, {}, 0)
    assert run.outcome == "passed", "unknown is not true"


@pytest.mark.parametrize(
    "loop",
    [
        (node("a", "exclusive", ("b", "1 > 0"), "end"), node("b", "exclusive", "a")),
        (node("a", "timer", "b", timer_ns=0), node("b", "exclusive", ("a", "1 > 0"), "end")),
    ],
)
def test_a_loop_without_a_way_out_ends_the_run(loop: Any) -> None:
    run = begun(process(node("start", "start", "a"), *loop, node("end", "end")))
    run.tick(S)
    assert run.outcome == "error"
    assert "elements" in run.reasons[0]


def test_a_long_loop_stays_small_and_does_not_get_lost() -> None:
    """SpiffWorkflow keeps every visit, and overlooks those that are more than 1000 deep."""
    robot = {"drive": RobotStepOptions("drive", results={"n": "n"})}
    of = procedure(
        process(
            node("start", "start", "drive"),
            node("drive", "robot", "g", boundaries=(timer("late", 60, "end"),)),
            node("g", "exclusive", ("sub", "n < 400"), "end"),
            node("sub", "inner", "drive", inner=process(
                node("s", "start", "fork"), node("fork", "parallel", "p1", "p2"),
                node("p1", "exclusive", "join"), node("p2", "exclusive", "join"),
                node("join", "parallel", "e"), node("e", "end"),
            )),
            node("end", "end"),
        ),
        robot=robot,
    )  # fmt: skip
    run = begun(of)
    sizes = []
    for n in range(401):
        run.robot_ended(drive(run, "drive", n), "done", n * S, "", {"n": n})
        sizes.append(len(json.dumps(json.loads(run.state())["tokens"])))
    assert run.outcome == "passed"
    assert max(sizes[2:-1]) < sizes[1] * 1.1


def test_a_terminate_end_ends_its_own_sub_process_only() -> None:
    def ended(path: str, kind: Any) -> Process:
        return process(
            node(f"{path}s", "start", f"{path}f"),
            node(f"{path}f", "parallel", f"{path}e", f"{path}p"),
            node(f"{path}p", "person", f"{path}n"), node(f"{path}n", "end"),
            node(f"{path}e", kind),
        )  # fmt: skip

    run = begun(
        process(
            node("start", "start", "sub"),
            node("sub", "inner", "look", inner=ended("i", "terminate_end")),
            node("look", "person", "end"), node("end", "end"),
        )
    )  # fmt: skip
    assert waiting(run) == ["look"]
    run = begun(ended("t", "terminate_end"))
    assert (run.outcome, list(run.reasons), run.person_tasks()) == ("passed", ["te"], [])


def test_no_python_of_a_diagram_is_evaluated(monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(UsageError):
        parse('__import__("os").getpid() > 0')
    run = begun(DRIVE_AND_RECOVER)  # all modules are loaded now

    def refuse(*_: Any) -> None:
        raise AssertionError("evaluated")

    monkeypatch.setattr(builtins, "eval", refuse)
    monkeypatch.setattr(builtins, "exec", refuse)
    run = begun(
        process(
            node("start", "start", "g"), node("g", "exclusive", ("drive", "1 > 0"), "end"),
            node("drive", "robot", "end"), node("end", "end"),
        )
    )  # fmt: skip
    run.robot_ended(drive(run, "drive"), "done", S)
    assert run.outcome == "passed"


def test_a_state_of_another_experiment_or_damaged_is_refused() -> None:
    run = begun(DRIVE_AND_RECOVER)
    state = run.state()
    changed = Procedure("test", "1" * 64, run.procedure.process, steps=run.procedure.steps)
    with pytest.raises(UsageError, match="has changed since the run began"):
        ExperimentRun.restore(changed, state)
    with pytest.raises(UsageError, match="damaged"):
        ExperimentRun.restore(run.procedure, state[:-20])
    other = json.loads(state) | {"tokens": {"visits": {}, "tokens": {"typename": "UUID"}}}
    with pytest.raises(UsageError, match="damaged"):
        ExperimentRun.restore(run.procedure, json.dumps(other).encode())
    with pytest.raises(UsageError, match="format 2"):
        newer = json.loads(state) | {"format": 2}
        ExperimentRun.restore(run.procedure, json.dumps(newer).encode())


def test_a_run_takes_so_many_notes(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("amberbox.experiments.run.MOST_REMARKS", 2)
    run = begun(DRIVE_AND_RECOVER)
    run.note("one", "ada", S)
    run.note("two", "ada", S)
    with pytest.raises(UsageError, match="has 2 notes already"):
        run.note("three", "ada", S)
    assert [event.text for event in run.events if event.kind == "note"] == ["one", "two"]


def test_notes_and_deviations_are_kept_against_their_step() -> None:
    run = begun(DRIVE_AND_RECOVER)
    run.deviation("drive.1", "it hums", "ada", S)
    run.note("door open", "ada", S)
    run.presence("operator", "ada", S)
    assert [(e.kind, e.element, e.text) for e in run.events[-3:]] == [
        ("deviation", "drive", "it hums"), ("note", "", "door open"), ("present", "", ""),
    ]  # fmt: skip
    with pytest.raises(UsageError, match="there is no step"):
        run.deviation("fly.1", "x", "ada", S)
    for text in ("  ", "x" * 2001):
        with pytest.raises(UsageError, match="the text"):
            run.note(text, "ada", S)
