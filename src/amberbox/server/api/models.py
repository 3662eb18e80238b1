"""Routes of models of detectors: learn one from missions of robots, follow it, fetch its file."""

from __future__ import annotations

from typing import Annotated, Any

from fastapi import Path, Query
from fastapi.responses import FileResponse
from pydantic import Field

from amberbox.core.api import DetectorAlarmLine, FollowingModel, LearntModel
from amberbox.server.http.auth import Fleet, Routes, Who
from amberbox.server.http.forms import ID, Form, From, Id, To, download_headers
from amberbox.server.services import models

routes = Routes("models")

ModelId = Annotated[str, Path(pattern=r"^m-[0-9a-f]{24}$")]
_Robot = Annotated[str, Query(pattern=ID)]
_Mission = Annotated[str, Field(min_length=1, max_length=80)]
_Detector = Annotated[str, Field(pattern=r"^[a-z0-9_]{1,40}$")]
_Time = Annotated[str, Field(max_length=64)]


class NewModel(Form):
    """What to learn: detectors, from nominal missions of robots.

    ``missions`` are names or ids, without any all that did not fail. ``from`` and ``to`` limit the
    time, ``options`` are those of each detector by its name. ``name`` is for its versions: without
    it that of the robot, ``team`` or ``fleet``. Of a ``team`` the robots are learnt side by side,
    while all of them were on nominal missions.
    """

    robots: Annotated[list[Id], Field(min_length=1, max_length=100)]
    name: Annotated[str, Field(pattern=rf"{ID}|^$")] = ""
    missions: Annotated[list[_Mission], Field(max_length=200, default_factory=list)]
    from_: Annotated[_Time, Field(alias="from")] = ""
    to: _Time = ""
    detectors: Annotated[list[_Detector], Field(max_length=20, default_factory=list)]
    false_alarms_per_hour: Annotated[float, Field(gt=0, le=1e6, allow_inf_nan=False)] = 1.0
    options: Annotated[dict[_Detector, Any], Field(max_length=20, default_factory=dict)]
    team: bool = False


@routes.post("/models", "models.write", each=True, status_code=202)
def learn_model(fleet: Fleet, who: Who, new: NewModel) -> LearntModel:
    """Learn a model in the background, as the next version of its name."""
    return models.learn_model(
        fleet, who, new.robots, new.name, new.missions, new.from_, new.to, new.detectors,
        new.false_alarms_per_hour, new.options, team=new.team,
    )  # fmt: skip


@routes.get("/models", "models.read", each=True)
def list_models(
    fleet: Fleet, who: Who,
    name: Annotated[str, Query(pattern=rf"{ID}|^$", description="empty: of all names")] = "",
) -> list[LearntModel]:  # fmt: skip
    """List the models of which one sees all robots, newest first."""
    return models.list_models(fleet, who, name)


@routes.get("/models/{id}", "models.read", each=True)
def read_model(fleet: Fleet, who: Who, id: ModelId) -> LearntModel:
    """Tell how far a model is, and what it promises."""
    return models.read_model(fleet, who, id)


@routes.get("/models/{id}/alarms", "models.read", each=True)
def detect_with_model(
    fleet: Fleet, who: Who, id: ModelId, from_: From, to: To,
    robot: Annotated[list[_Robot], Query(max_length=100)] = [],  # noqa: B006 - FastAPI copies it
) -> list[DetectorAlarmLine]:  # fmt: skip
    """Run a model over what robots recorded, its own if none is named; at most a day.

    Detection begins anew with the range, and is bounded as queries are.
    """
    return models.detect_with_model(fleet, who, id, robot, from_, to)


class NewFollowing(Form):
    """Since when a model of a team is to follow its robots; now if it is empty."""

    from_: Annotated[_Time, Field(alias="from")] = ""


@routes.post("/models/{id}/follow", "models.write", each=True)
def follow_with_model(fleet: Fleet, who: Who, id: ModelId, new: NewFollowing) -> FollowingModel:
    """Let a model of a team follow what its robots hand in, unless it does already."""
    return models.follow_with_model(fleet, who, id, new.from_)


@routes.get("/models/{id}/follow", "models.read", each=True)
def following_model(fleet: Fleet, who: Who, id: ModelId) -> FollowingModel:
    """Tell how far a model that follows its robots is, and which alarms it has found."""
    return models.following_model(fleet, who, id)


@routes.delete("/models/{id}/follow", "models.write", each=True)
def unfollow_model(fleet: Fleet, who: Who, id: ModelId) -> LearntModel:
    """Let a model follow no longer, and forget its alarms."""
    return models.unfollow_model(fleet, who, id)


@routes.delete("/models/{id}", "models.write", each=True)
def delete_model(fleet: Fleet, who: Who, id: ModelId) -> LearntModel:
    """Stop learning a model, or delete one that is over."""
    return models.delete_model(fleet, who, id)


@routes.get(
    "/models/{id}/file", "data.download", each=True, response_class=FileResponse,
    responses={
        200: {"description": "the file", "content": {"application/octet-stream": {}}},
        206: {"description": "a part of it, as the header Range asks"},
        416: {"description": "there is no such part"},
    },
)  # fmt: skip
def fetch_model(fleet: Fleet, who: Who, id: ModelId) -> FileResponse:
    """Fetch the file of a model, at most 8 MiB."""
    model, path = models.model_file(fleet, who, id)
    return FileResponse(
        path, media_type="application/octet-stream", headers=download_headers(model.file)
    )
