"""The cart experiment on all its paths, in simulated time, with restarts at every step."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from amberbox.experiments.procedure import Procedure, procedure_of
from amberbox.experiments.profile import read_experiment
from amberbox.experiments.run import ExperimentRun, RobotEnd
from tests.experiments.procedures import S, bpmn_of, catch, node, process, timer

# What the file of the paper's experiment leaves to a file beside it
BESIDE = """\
experiment:
  ends: {end_abort: aborted}
steps:
  t_safe:
    fields: {path_clear: {kind: pass_fail, label: Is the path clear?}}
  r_drive: {action: drive, errors: {failed: robot_error}}
  r_dock: {action: dock, errors: {failed: dock_failed}}
  r_transport: {action: transport, errors: {failed: robot_error}}
"""
TWIN = process(
    node("start", "start", "t_select"),
    node("t_select", "person", "t_place"),
    node("t_place", "person", "t_safe"),
    node("t_safe", "person", "g_safe"),
    node("g_safe", "exclusive", ("r_drive", "path_clear"), "end_abort"),
    node("end_abort", "end"),
    node(
        "r_drive", "robot", "r_dock",
        boundaries=(
            timer("b_drive_to", 2, "t_recover"), catch("b_drive_err", "robot_error", "t_recover")
        ),
    ),
    node(
        "r_dock", "robot", "r_transport",
        boundaries=(catch("b_dock_err", "dock_failed", "t_recover"),),
    ),
    node(
        "r_transport", "robot", "t_receive",
        boundaries=(
            catch("b_tr_err", "robot_error", "t_recover"),
            timer("b_tr_slow", 1, "t_notify", interrupts=False),
        ),
    ),
    node("t_receive", "person", "t_deviation"),
    node("t_deviation", "person", "end_ok"),
    node("end_ok", "end"),
    node("t_recover", "person", "t_diag"),
    node("t_diag", "person", "end_fail"),
    node("end_fail", "error_end", code="test_failed"),
    node("t_notify", "person", "end_notify"),
    node("end_notify", "end"),
)  # fmt: skip

HAPPY = ["t_select", "t_place", "t_safe", "r_drive", "r_dock", "r_transport", "t_receive",
         "t_deviation"]  # fmt: skip
RECOVERED = ["t_recover", "t_diag"]


@pytest.fixture(
    params=[pytest.param("paper", marks=pytest.mark.needs_data), "twin"], scope="module"
)
def cart(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Procedure:
    folder = tmp_path_factory.mktemp("cart")
    path = folder / "cart_transport.bpmn"
    if request.param == "paper":
        shared: Path = request.getfixturevalue("shared_data")
        path.write_bytes((shared / "bpmn" / path.name).read_bytes())
    else:
        path.write_text(bpmn_of(TWIN))
    (folder / "cart_transport.yaml").write_text(BESIDE)
    experiment, problems = read_experiment(path)
    assert experiment is not None, problems
    return procedure_of(experiment)


class Story:
    """A run in which everything goes well, apart from what is given for some steps.

    ``restarts``: the run is saved and restored after each call, and each end is said twice.
    """

    def __init__(self, cart: Procedure, restarts: bool, ends: dict[str, Any]) -> None:
        self.cart, self.restarts, self.ends = cart, restarts, ends
        self.now_ns = 0
        self.order: list[str] = []
        self.commands: list[str] = []
        self.run = ExperimentRun.begin(cart, "r", "robo", {}, {}, 0)

    def play(self) -> ExperimentRun:
        while self.run.outcome is None or not self.run.is_closed:
            self._step()
            if self.restarts:
                self.run = ExperimentRun.restore(self.cart, self.run.state())
        return self.run

    def _step(self) -> None:
        for stop in self.run.stop_orders():
            self._ended(stop.task, "aborted")
            return
        for going_on in self.run.running():
            self._work(going_on.id, self.ends.get(going_on.step.path, "done"))
            return
        for task in self.run.robot_tasks():
            self.order.append(task.step.path)
            self.commands.append(task.id)
            self.run.robot_started(task.id, f"c-{task.id}", self.now_ns)
            return
        person = self.run.person_tasks()[0]
        self.order.append(person.step.path)
        is_clear = self.ends.get("t_safe", True)
        self.run.complete(
            person.id, dict.fromkeys(person.form.fields, is_clear), "ada", self.now_ns
        )

    def _work(self, task: str, end: RobotEnd | float) -> None:
        """Let the robot end, or let time pass: a number of seconds."""
        if isinstance(end, float):
            path = task.partition(".")[0]
            self.ends.pop(path)
            self.now_ns += int(end * S)
            self.run.tick(self.now_ns)
        else:
            self._ended(task, end)

    def _ended(self, task: str, end: RobotEnd) -> None:
        for _ in range(2 if self.restarts else 1):
            self.run.robot_ended(task, end, self.now_ns, "as told")


@pytest.mark.parametrize(
    ("ends", "order", "outcome"),
    [
        ({}, HAPPY, "passed"),
        ({"t_safe": False}, HAPPY[:3], "aborted"),
        ({"r_drive": 2.0}, [*HAPPY[:4], *RECOVERED], "failed"),
        ({"r_transport": 1.0}, [*HAPPY[:6], "t_notify", *HAPPY[6:]], "passed"),
        ({"r_dock": "failed"}, [*HAPPY[:5], *RECOVERED], "failed"),
        ({"r_drive": "failed"}, [*HAPPY[:4], *RECOVERED], "failed"),
        ({"r_dock": "aborted"}, HAPPY[:5], "failed"),
        ({"r_transport": "outcome_unknown"}, HAPPY[:6], "failed"),
    ],
    ids=["normal", "not safe", "timeout", "slow", "docking", "robot error", "uncaught", "unknown"],
)  # fmt: skip
@pytest.mark.parametrize("restarts", [False, True])
def test_the_cart_goes_every_path(
    cart: Procedure, ends: dict[str, Any], order: list[str], outcome: str, restarts: bool
) -> None:
    story = Story(cart, restarts, dict(ends))
    run = story.play()
    assert sorted(story.order) == sorted(order)
    assert [path for path in story.order if path != "t_notify"] == [
        path for path in order if path != "t_notify"
    ]
    assert run.outcome == outcome
    assert len(story.commands) == len(set(story.commands))
    if not restarts:
        again = Story(cart, True, dict(ends)).play()
        assert again.events == run.events
