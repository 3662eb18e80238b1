"""The pages of runs: whose turn it is, the diagram and its list, plots, events; reports."""

from __future__ import annotations

import re
from base64 import b64encode
from collections.abc import Mapping
from hashlib import sha256
from html import unescape
from pathlib import Path
from typing import Annotated, Any, Final, Literal, get_args

from fastapi import HTTPException, Query, Request, Response
from fastapi import Path as fastapi_Path
from fastapi.concurrency import run_in_threadpool
from fastapi.responses import FileResponse, HTMLResponse
from starlette.responses import RedirectResponse

from amberbox.core.api import RunLine, RunState
from amberbox.core.errors import AmberboxError
from amberbox.experiments.experiment import PersonStepOptions
from amberbox.server.accounts.robots import KnownRobot
from amberbox.server.experiments.runs import OPEN, StoredRun
from amberbox.server.http.auth import Fields, Fleet, Who
from amberbox.server.http.errors import status_of
from amberbox.server.services import experiments, reports
from amberbox.server.services.context import Caller, Services
from amberbox.server.web.page import PageRoutes, render
from amberbox.server.web.run_view import Typed, act_on, in_page, run_view, typed_of, visible_run

routes = PageRoutes()

STEP: Final = 50
"""Number of runs on a page of the list."""
_PICTURES: Mapping[str, str] = {
    ".png": "image/png", ".jpg": "image/jpeg", ".jpeg": "image/jpeg", ".svg": "image/svg+xml",
}  # fmt: skip
# A picture comes from a robot or an upload: nothing in it may run, wherever it is opened
_PICTURE_POLICY: Final = "default-src 'none'; style-src 'unsafe-inline'; sandbox"
_STYLE = re.compile(r"<style>(.*?)</style>", re.DOTALL)

RunId = Annotated[str, fastapi_Path(max_length=64)]
FileName = Annotated[str, fastapi_Path(max_length=255)]
Name = Annotated[str, Query(max_length=128)]
Which = Literal["all", "open", "over"]
_OVER = tuple(state for state in get_args(RunState) if state not in OPEN)
_STATES: Mapping[Which, tuple[RunState, ...]] = {"all": (), "open": tuple(OPEN), "over": _OVER}


@routes.get("/runs", "experiments.read", each=True)
def show_runs(
    request: Request, fleet: Fleet, who: Who, show: Which = "all", robot: Name = "",
    name: Name = "", after: Annotated[int, Query(ge=0, le=2**62)] = 0,
) -> Response:  # fmt: skip
    """Show the runs, the newest first."""
    shown = _listed(fleet, who, show, robot, name, after)
    return render(request, "runs/runs.html", strings=("runs",), **shown)


@routes.get("/pieces/runs", "experiments.read", each=True)
def show_run_list(
    request: Request, fleet: Fleet, who: Who, show: Which = "all", robot: Name = "",
    name: Name = "", after: Annotated[int, Query(ge=0, le=2**62)] = 0,
) -> Response:  # fmt: skip
    """Return the fragment with the list of runs."""
    return render(request, "runs/list.html", **_listed(fleet, who, show, robot, name, after))


def _listed(
    fleet: Services, who: Caller, show: Which, robot: str, name: str, after: int
) -> Mapping[str, Any]:
    with fleet.database.reading() as connection:
        seen = [one.id for one in who.robots(connection, "experiments.read")]
    found = experiments.list_runs(
        fleet, [one for one in seen if robot in ("", one)], state=_STATES[show], name=name,
        after=after, limit=STEP + 1,
    )  # fmt: skip
    return {
        "runs": found[:STEP], "more": found[STEP - 1].number if len(found) > STEP else 0,
        "show": show, "robot": robot, "name": name, "robots": seen, "after": after,
    }  # fmt: skip


@routes.get("/runs/{id}", "experiments.read", each=True)
def show_run(request: Request, fleet: Fleet, who: Who, id: RunId) -> Response:
    """Show a run."""
    return _page(request, fleet, who, *visible_run(fleet, who, id), Typed())


@routes.get("/pieces/runs/{id}", "experiments.read", each=True)
def show_run_parts(request: Request, fleet: Fleet, who: Who, id: RunId) -> Response:
    """Return the fragment of a run's page that changes."""
    shown = _shown(fleet, who, *visible_run(fleet, who, id), Typed())
    return render(request, "runs/parts.html", **shown)


@routes.form("/runs/{id}", "experiments.step", each=True)
async def act_on_run(
    request: Request, fleet: Fleet, who: Who, id: RunId, fields: Fields
) -> Response:
    """Do what a form of the page asks for: end a step, note a deviation, pause, abort ..."""
    robot, stored = await run_in_threadpool(visible_run, fleet, who, id)
    problem, done = None, ""
    try:
        done = await act_on(fleet, who, robot, stored, fields)
    except AmberboxError as error:
        problem = error
    if done not in ("", "deviation"):
        return RedirectResponse(f"/runs/{stored.id}", 303)
    typed = typed_of(fields, problem, done)
    return await run_in_threadpool(_page, request, fleet, who, robot, stored, typed)


def _page(
    request: Request, fleet: Services, who: Caller, robot: KnownRobot, stored: StoredRun,
    typed: Typed,
) -> Response:  # fmt: skip
    shown = _shown(fleet, who, robot, stored, typed)
    status = status_of(typed.problem) if typed.problem is not None else 200
    like = experiments.list_runs(fleet, [robot.id], name=stored.name, limit=STEP)
    earlier = [one for one in like if _is_comparable(one, stored)]
    return render(
        request, "runs/run.html", status, strings=("plot",), earlier=earlier, **shown
    )  # fmt: skip


def _shown(
    fleet: Services, who: Caller, robot: KnownRobot, stored: StoredRun, typed: Typed
) -> Mapping[str, Any]:
    view = run_view(fleet, who, robot, stored)
    drawing = in_page(view.drawing) if view.drawing is not None else None
    return {"view": view, "drawing": drawing, "typed": typed, "here": f"/runs/{stored.id}"}


def _is_comparable(one: RunLine, stored: StoredRun) -> bool:
    is_same = one.id != stored.id and one.kind == stored.kind and one.sha256 == stored.sha256
    return is_same and one.begun is not None


@routes.get("/runs/{id}/pictures/{file}", "experiments.read", each=True)
def read_picture(fleet: Fleet, who: Who, id: RunId, file: FileName) -> Response:
    """Return a picture of a step."""
    _, stored = visible_run(fleet, who, id)
    steps = fleet.runner.shelf.procedure(stored).steps.values()
    known = {(step.person or PersonStepOptions()).picture for step in steps} - {""}
    kind = _PICTURES.get(Path(file).suffix.lower())
    path = fleet.runner.shelf.place(stored.sha256) / Path(file).name
    if file not in known or kind is None or not path.is_file():
        raise HTTPException(404, "there is no such picture")
    headers = {"Content-Security-Policy": _PICTURE_POLICY, "Cache-Control": "private, max-age=3600"}
    return FileResponse(path, media_type=kind, headers=headers)


@routes.get("/runs/{id}/report", "experiments.read", each=True)
async def show_report(fleet: Fleet, who: Who, id: RunId) -> Response:
    """Show the report of a run, as it is downloaded and printed."""
    robot, stored = await run_in_threadpool(visible_run, fleet, who, id)
    found = await reports.report(fleet, who, robot.id, stored.id, "html")
    page = found if isinstance(found, str) else found.decode()
    # within SVG a style is read as XML, where what was escaped is not
    written = {text for one in _STYLE.findall(page) for text in (one, unescape(one))}
    hashes = sorted(b64encode(sha256(one.encode()).digest()).decode() for one in written)
    styles = " ".join(f"'sha256-{one}'" for one in hashes)
    policy = f"default-src 'none'; img-src data:; style-src {styles}; frame-ancestors 'none'"
    return HTMLResponse(page, headers={"Content-Security-Policy": policy})


@routes.get("/runs/{id}/comparison", "experiments.read", each=True)
async def show_comparison(
    request: Request, fleet: Fleet, who: Who, id: RunId,
    run: Annotated[list[Annotated[str, Query(max_length=64)]], Query(max_length=20)] = [],  # noqa: B006 - FastAPI copies it
    since: Annotated[str, Query(max_length=64)] = "",
) -> Response:  # fmt: skip
    """Compare a run with others of the same experiment on the same robot."""
    robot, stored = await run_in_threadpool(visible_run, fleet, who, id)
    ids = list(dict.fromkeys([stored.id, *run]))
    found = await reports.compare(fleet, who, robot.id, ids, since)
    return await run_in_threadpool(_comparison, request, fleet, who, robot, stored, ids, found)


def _comparison(
    request: Request, fleet: Services, who: Caller, robot: KnownRobot, stored: StoredRun,
    ids: list[str], found: Mapping[str, Any],
) -> Response:  # fmt: skip
    lines = [experiments.run_line(experiments.find_run(fleet, robot.id, one)) for one in ids]
    plots = fleet.runner.shelf.procedure(stored).options.plots
    return render(
        request, "runs/comparison.html", strings=("runs", "plot", "data"), run=lines[0],
        lines=sorted(lines, key=lambda one: one.begun or ""), found=found, plots=plots,
        drawn=[{"id": one.id, "from": one.begun, "to": one.ended} for one in lines],
    )  # fmt: skip
