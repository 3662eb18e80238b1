"""Runs of random procedures: as an interpreter of the blocks says, over restarts at every step."""

from __future__ import annotations

import contextlib

from hypothesis import given, settings
from hypothesis import strategies as st

from amberbox.core.errors import UsageError
from amberbox.experiments.experiment import RobotStepOptions
from amberbox.experiments.procedure import Procedure
from amberbox.experiments.run import ExperimentRun, PersonTask, RobotTask
from tests.experiments.procedures import (
    PASS_FAIL,
    Block,
    S,
    Walk,
    blocks,
    built,
    catch,
    node,
    procedure,
    process,
    timer,
)

_STEPS = 40


def _waiting(run: ExperimentRun) -> list[str]:
    tasks: list[PersonTask | RobotTask] = [*run.person_tasks(), *run.robot_tasks(), *run.running()]
    return sorted(task.step.path for task in tasks)


def _restored(run: ExperimentRun, procedure: Procedure) -> ExperimentRun:
    return ExperimentRun.restore(procedure, run.state())


@given(block=blocks(), picks=st.lists(st.integers(0, 11), min_size=1, max_size=_STEPS))
@settings(max_examples=150)
def test_a_run_waits_where_its_blocks_say_and_restarts_change_nothing(
    block: Block, picks: list[int]
) -> None:
    procedure, walk = built(block), Walk.begin(block)
    run = ExperimentRun.begin(procedure, "r", "robot", {}, {}, 0)
    other = ExperimentRun.begin(procedure, "r", "robot", {}, {}, 0)
    is_caught = True
    for number, pick in enumerate(picks, 1):
        if walk.is_done or not is_caught:
            break
        assert _waiting(run) == sorted(walk.waiting())
        run = _do(_restored(run, procedure), pick, number * S)
        _do(other, pick, number * S, restart=False)
        name = next(e.element for e in reversed(other.events) if e.kind in ("done", "ended"))
        if procedure.steps[name].robot is not None and pick % 3 == 0:
            is_caught = walk.fail(name)
        else:
            walk.finish(name, again=pick % 2 == 0)
    assert run.events == other.events
    assert not run.stop_orders()
    if not is_caught:
        assert run.outcome == "failed" and run.is_closed
    if walk.is_done:
        assert run.outcome in ("passed", "failed") and run.is_closed
        assert not _waiting(run)


def _do(run: ExperimentRun, pick: int, now_ns: int, restart: bool = True) -> ExperimentRun:
    """Do one of the steps that wait, with a restart while the robot is at it."""
    tasks: list[PersonTask | RobotTask] = [*run.person_tasks(), *run.robot_tasks()]
    tasks.sort(key=lambda task: task.step.path)
    task = tasks[pick % len(tasks)]
    if isinstance(task, PersonTask):
        run.complete(task.id, dict.fromkeys(task.form.fields, pick % 2 == 0), "ada", now_ns)
        return run
    run.robot_started(task.id, f"command of {task.id}", now_ns)
    run = _restored(run, run.procedure) if restart else run
    assert task.id not in {one.id for one in run.robot_tasks()}
    run.robot_ended(task.id, "failed" if pick % 3 == 0 else "done", now_ns)
    return run


def _driving() -> Procedure:
    """Return a procedure with timers, errors and branches, of which a robot may be in two."""
    inside = process(
        node("sub_start", "start", "sub_fork"),
        node("sub_fork", "parallel", "dock", "watch"),
        node("dock", "robot", "docked", boundaries=(catch("dock_error", "dock", "redock"),)),
        node("redock", "person", "docked"),
        node("docked", "exclusive", "sub_join"),
        node("watch", "person", "sub_join"),
        node("sub_join", "parallel", "sub_end"),
        node("sub_end", "end"),
    )
    return procedure(
        process(
            node("start", "start", "ask"),
            node("ask", "person", "drive"),
            node(
                "drive", "robot", "wait",
                boundaries=(
                    timer("too_long", 20, "recover"), timer("slow", 5, "note", interrupts=False),
                    catch("robot_error", "robot", "recover"),
                ),
            ),
            node("note", "person", "noted"),
            node("noted", "end"),
            node("wait", "timer", "sub", timer_ns=2 * S),
            node(
                "sub", "inner", "again", inner=inside,
                boundaries=(timer("sub_long", 30, "recover"), catch("sub_error", "", "recover")),
            ),
            node("again", "exclusive", ("ask", "go_on"), "end"),
            node("recover", "robot", "bad"),
            node("bad", "error_end", code="test_failed"),
            node("end", "end"),
        ),
        forms={"ask": {"go_on": PASS_FAIL}},
        robot={
            "drive": RobotStepOptions(action="drive", errors={"failed": "robot"}),
            "dock": RobotStepOptions(action="dock", errors={"failed": "dock"}),
        },
    )  # fmt: skip


_CALLS = st.tuples(
    st.sampled_from([
        "complete", "complete", "start", "start", "start", "done", "done", "failed", "aborted",
        "outcome_unknown", "tick", "tick", "pause", "resume", "end again", "note", "abort",
    ]),
    st.integers(0, 5),
    st.integers(0, 12),
)  # fmt: skip


def _call(run: ExperimentRun, what: str, pick: int, now_ns: int) -> str:
    """Do one thing to a run, if it can be done; return the id of a step that was started."""
    if what == "complete" and (tasks := run.person_tasks()):
        task = tasks[pick % len(tasks)]
        run.complete(task.id, dict.fromkeys(task.form.fields, pick % 2 == 0), "ada", now_ns)
    elif what == "start" and (robot_tasks := run.robot_tasks()):
        robot_task = robot_tasks[pick % len(robot_tasks)]
        run.robot_started(robot_task.id, f"command of {robot_task.id}", now_ns)
        return robot_task.id
    elif what in ("done", "failed", "aborted", "outcome_unknown"):
        begun = [task.id for task in run.running()] + [order.task for order in run.stop_orders()]
        if begun:
            run.robot_ended(begun[pick % len(begun)], what, now_ns)  # type: ignore[arg-type]  # drawn
    elif what == "end again":
        ended = [event for event in run.events if event.kind == "ended"]
        if ended:
            event = ended[pick % len(ended)]
            run.robot_ended(event.task, event.values["state"], now_ns)
    elif what == "tick":
        run.tick(now_ns)
    elif what in ("pause", "resume", "abort"):
        getattr(run, what)("ada", "", now_ns)
    elif what == "note":
        run.note("seen", "ada", now_ns)
    return ""


@given(calls=st.lists(_CALLS, max_size=40))
@settings(max_examples=200)
def test_nothing_is_done_twice_and_restarts_change_nothing(
    calls: list[tuple[str, int, int]],
) -> None:
    procedure, now_ns = _driving(), 0
    run = ExperimentRun.begin(procedure, "r", "robot", {}, {}, 0)
    other = ExperimentRun.begin(procedure, "r", "robot", {}, {}, 0)
    started: list[str] = []
    for what, pick, seconds in calls:
        now_ns += seconds * S
        try:
            task = _call(run, what, pick, now_ns)
        except UsageError as error:  # a timer came first
            assert error.what
            task = ""
        with contextlib.suppress(UsageError):
            _call(other, what, pick, now_ns)
        started += [task] if task else []
        run = _restored(run, procedure)
        assert run.events == other.events
        assert not run.robot_tasks() or not run.stop_orders()
        assert not {one.id for one in run.robot_tasks()} & set(started)
    assert len(started) == len(set(started))
    ended = [event.task for event in run.events if event.kind == "ended"]
    assert len(ended) == len(set(ended))
    going_on = {one.id for one in run.running()} | {order.task for order in run.stop_orders()}
    assert going_on == set(started) - set(ended)
    if run.outcome is not None:
        assert not run.person_tasks() and not run.robot_tasks() and not run.running()
        assert [event.kind for event in run.events].count("over") == 1
        _finish_stops(run, now_ns)
        run.abort("eve", "", now_ns)
        run.tick(now_ns + 1000 * S)
        assert run.is_closed and [event.kind for event in run.events].count("over") == 1


def _finish_stops(run: ExperimentRun, now_ns: int) -> None:
    for order in run.stop_orders():
        run.robot_ended(order.task, "aborted", now_ns)
