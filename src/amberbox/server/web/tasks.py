"""The page of the person at the robot: one step at a time, large enough for a phone."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, Any, Literal, TypeAlias, get_args

from fastapi import Query, Request, Response
from fastapi.concurrency import run_in_threadpool
from starlette.responses import RedirectResponse

from amberbox.core.api import PersonStep, RunLine
from amberbox.core.errors import AmberboxError
from amberbox.server.experiments.runs import HOLDING
from amberbox.server.http.auth import Fields, Fleet, Who
from amberbox.server.http.errors import status_of
from amberbox.server.services import experiments
from amberbox.server.services.context import Caller, Services
from amberbox.server.web.page import PageRoutes, render
from amberbox.server.web.run_view import (
    RunView,
    Typed,
    act_on,
    run_view,
    typed_of,
    visible_run,
)

routes = PageRoutes()

Text = Annotated[str, Query(max_length=64)]
# What the page shows: a step to be done, what the robot does, a step of somebody else, the end
Turn: TypeAlias = Literal["mine", "robot", "others", "over", "nothing"]


@dataclass(frozen=True, slots=True)
class TaskView:
    """What is to be done now; ``runs`` are those that one may take part in."""

    turn: Turn
    runs: Sequence[RunLine]
    run: RunView | None = None
    step: PersonStep | None = None

    @property
    def progress(self) -> tuple[int, int]:
        """Return the place of the present step and the number of all; 0 where it has none."""
        if self.run is None:
            return 0, 0
        waits = [self.step] if self.step else self.run.detail.robot
        return self.run.progress(waits[0].element) if waits else (0, 0)


@routes.get("/tasks", "experiments.step", each=True)
def show_tasks(request: Request, fleet: Fleet, who: Who, run: Text = "") -> Response:
    """Show the step that the caller can do now."""
    return render(request, "tasks/tasks.html", strings=("runs",), **_shown(fleet, who, run))


@routes.get("/pieces/tasks", "experiments.step", each=True)
def show_task(request: Request, fleet: Fleet, who: Who, run: Text = "") -> Response:
    """Return the fragment with the step that the caller can do now."""
    return render(request, "tasks/parts.html", **_shown(fleet, who, run))


@routes.form("/tasks", "experiments.step", each=True)
async def act_on_task(
    request: Request, fleet: Fleet, who: Who, fields: Fields, run: Text = ""
) -> Response:
    """Do what the form of the step asks for."""
    problem, done = None, ""
    try:
        robot, stored = await run_in_threadpool(visible_run, fleet, who, run)
        done = await act_on(fleet, who, robot, stored, fields)
    except AmberboxError as error:
        problem = error
    if done not in ("", "deviation"):
        return RedirectResponse(f"/tasks?run={stored.id}", 303)
    typed = typed_of(fields, problem, done)
    shown = await run_in_threadpool(_shown, fleet, who, run, typed)
    status = status_of(problem) if problem is not None else 200
    return await run_in_threadpool(
        render, request, "tasks/tasks.html", status, strings=("runs",), **shown
    )


def _shown(fleet: Services, who: Caller, run: str, typed: Typed | None = None) -> Mapping[str, Any]:
    with fleet.database.reading() as connection:
        mine = [robot.id for robot in who.robots(connection, "experiments.step")]
    on = experiments.list_runs(fleet, mine, state=HOLDING, limit=20)
    task = _task(fleet, who, on, run)
    here = f"/tasks?run={task.run.detail.run.id}" if task.run else "/tasks"
    return {"task": task, "typed": typed or Typed(), "here": here, "wanted": run}


def _task(fleet: Services, who: Caller, on: Sequence[RunLine], wanted: str) -> TaskView:
    """Return the wanted run; else the first in which a step waits for the caller."""
    if wanted:
        views = [run_view(fleet, who, *visible_run(fleet, who, wanted))]
    else:
        views = [run_view(fleet, who, *visible_run(fleet, who, one.id)) for one in on]
    order: Sequence[Turn] = get_args(Turn)
    view = min(views, key=lambda one: order.index(_turn(one)), default=None)
    if view is None:
        return TaskView("nothing", on)
    turn = _turn(view)
    step = next((one for one in view.detail.people if one.mine or turn == "others"), None)
    return TaskView(turn, on, view, step)


def _turn(view: RunView) -> Turn:
    if not view.is_on:
        return "over"
    if any(one.mine for one in view.detail.people):
        return "mine"
    if view.robot_steps:
        return "robot"
    return "others"
