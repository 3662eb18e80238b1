"""Learnt models as API and pages show them: start one, follow it, fetch its file, delete it."""

from __future__ import annotations

import shutil
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import msgspec
from sqlalchemy import Connection

from amberbox.core.api import DetectorAlarmLine, FollowingModel, LearntModel
from amberbox.core.clock import NS
from amberbox.core.errors import UsageError
from amberbox.core.timestamps import format_time, maybe_time
from amberbox.detection.learn import DEFAULT_DETECTORS, make_detectors, options_of
from amberbox.server import commands
from amberbox.server.bus import ServerChange
from amberbox.server.learning import models
from amberbox.server.learning.following import FollowState
from amberbox.server.learning.models import LearnRequest, StoredModel
from amberbox.server.live.records import clock_offsets_ns
from amberbox.server.services.context import Caller, NotFoundError, Services, robot_span_ns
from amberbox.server.workers.jobs import OPEN

_WORKER = "amberbox.server.learning.worker"
_MOST_OPTIONS = 64 << 10
_OF_TEAM = "state_flow"
_LONGEST_NS = 24 * 3600 * NS


def learn_model(
    fleet: Services, who: Caller, robots: Sequence[str], name: str = "",
    missions: Sequence[str] = (), from_: str = "", to: str = "", detectors: Sequence[str] = (),
    false_alarms_per_hour: float = 1.0, options: Mapping[str, Any] | None = None, *,
    team: bool = False,
) -> LearntModel:  # fmt: skip
    """Queue a model; without a name it has that of its robot, ``team`` or ``fleet``.

    Raises NotFoundError for a robot that the caller may not learn from, UsageError for detectors
    and options that cannot be.
    """
    given, named = dict(options or {}), list(dict.fromkeys(robots))
    if team:
        given = _team_options(given, named)
    if len(msgspec.json.encode(given)) > _MOST_OPTIONS:
        raise UsageError(f"options have at most {_MOST_OPTIONS >> 10} KiB")
    usual = [*given] if team else [*DEFAULT_DETECTORS, *given]
    chosen = list(dict.fromkeys(detectors or usual))
    make_detectors(chosen, options_of(given))
    span = robot_span_ns(fleet, named[0], from_, to)
    wanted = LearnRequest(named, chosen, [*missions], *span, false_alarms_per_hour, given, team)
    with fleet.database.begin() as connection:
        _check_robots(connection, who, "models.write", named)
        now_ns = fleet.clock.wall_ns()
        called = name or (named[0] if len(named) == 1 else "team" if team else "fleet")
        model = models.add(connection, now_ns, who.person, called, wanted)
        about = {
            "name": model.name, "version": model.version, "robots": named, "missions": [*missions],
            "from": maybe_time(span[0]), "to": maybe_time(span[1]), "detectors": chosen,
            "team": team,
        }  # fmt: skip
        who.note(connection, now_ns, "models.learn", model.id, details=about)
    _publish(fleet, model)
    return model_line(model)


def list_models(fleet: Services, who: Caller, name: str = "") -> list[LearntModel]:
    """List the models of which the caller sees all robots, newest first."""
    with fleet.database.reading() as connection:
        mine = _robots(connection, who, "models.read")
        found = models.listed(connection, name)
    return [model_line(one) for one in found if mine.issuperset(one.wanted.robots)]


def model_takers(fleet: Services, who: Caller) -> set[str]:
    """Return the robots that install models, and that the caller may command."""
    with fleet.database.reading() as connection:
        return _robots(connection, who, "commands.write") & commands.model_takers(connection)


def read_model(fleet: Services, who: Caller, model_id: str) -> LearntModel:
    """Return a model; raises NotFoundError."""
    with fleet.database.reading() as connection:
        return model_line(_find(connection, who, "models.read", model_id))


def delete_model(fleet: Services, who: Caller, model_id: str) -> LearntModel:
    """Cancel a model that is not learnt yet; delete any other with its file."""
    with fleet.database.begin() as connection:
        model, now_ns = _find(connection, who, "models.write", model_id), fleet.clock.wall_ns()
        ended = {"ended_ns": now_ns, "progress": 0.0}
        if models.change(connection, model_id, only=OPEN, state="cancelled", **ended):
            model = _find(connection, who, "models.write", model_id)
            who.note(connection, now_ns, "models.cancel", model_id)
        else:
            models.delete(connection, model_id)
            details = {"name": model.name, "version": model.version}
            who.note(connection, now_ns, "models.delete", model_id, details=details)
    fleet.learning.cancel(model)
    if model.state == "done":
        shutil.rmtree(fleet.learning.path(model).parent, ignore_errors=True)
    _publish(fleet, model)
    return model_line(model)


def model_file(fleet: Services, who: Caller, model_id: str) -> tuple[StoredModel, Path]:
    """Return a finished model and the path of its file, for a download that is audited.

    Raises NotFoundError for a model that is not finished, or has robots that are not the caller's.
    """
    with fleet.database.begin() as connection:
        model = _find(connection, who, "data.download", model_id)
        path = fleet.learning.path(model)
        if model.state != "done" or not path.is_file():
            raise NotFoundError(f"there is no file: the model is {model.state}")
        details = {"file": model.file, "sha256": model.sha256}
        now_ns = fleet.clock.wall_ns()
        who.note(connection, now_ns, "models.fetch", model_id, details=details)
    return model, path


def model_for_robot(fleet: Services, robot: str, sha256: str) -> Path:
    """Return the path of the model file that an open command to a robot names.

    Raises NotFoundError for any other one: a robot's key reads no models.
    """
    with fleet.database.reading() as connection:
        if sha256 in commands.models_to_install(connection, robot):
            for model in models.listed(connection):
                path = fleet.learning.path(model)
                if model.state == "done" and model.sha256 == sha256 and path.is_file():
                    return path
    raise NotFoundError("there is no such model, or no command to this robot installs it")


def detect_with_model(
    fleet: Services, who: Caller, model_id: str, robots: Sequence[str], from_: str, to: str
) -> list[DetectorAlarmLine]:
    """Return the alarms of a model on what robots recorded; its own robots if none is named.

    Raises UsageError without a range of at most a day, and for other robots than those of a team.
    """
    with fleet.database.reading() as connection:
        model = _find(connection, who, "models.read", model_id)
        named = list(dict.fromkeys(robots or model.wanted.robots))
        _check_robots(connection, who, "data.query", named)
    if model.state != "done":
        raise NotFoundError(f"there is no file: the model is {model.state}")
    if model.wanted.team and named != model.wanted.robots:
        raise UsageError("a model of a team is about all of its robots", "name no robot")
    from_ns, to_ns = robot_span_ns(fleet, named[0], from_, to)
    if from_ns is None or to_ns is None or to_ns - from_ns > _LONGEST_NS:
        raise UsageError("give a range of at most a day: from and to")
    arguments = {
        "id": model.id, "file": model.file, "robots": named, "team": model.wanted.team,
        "from_ns": from_ns, "to_ns": to_ns,
    }  # fmt: skip
    answer = fleet.worker_pool.ask_now(f"{_WORKER}:detect", arguments, origin=who.person)
    return [_alarm_line(found) for found in msgspec.json.decode(answer)]


def follow_with_model(
    fleet: Services, who: Caller, model_id: str, from_: str = ""
) -> FollowingModel:
    """Let a model of a team follow its robots from a time on, now by default, unless it does.

    Raises NotFoundError for a model that is not finished, UsageError for one of no team.
    """
    with fleet.database.reading() as connection:
        model = _find(connection, who, "models.write", model_id)
        robots = model.wanted.robots
        _check_robots(connection, who, "data.query", robots)
        ahead_ns = clock_offsets_ns(connection, robots)
    if model.state != "done":
        raise NotFoundError(f"there is no file: the model is {model.state}")
    if not model.wanted.team:
        hint = "install any other one on its robot, which follows its own record"
        raise UsageError("only a model of a team follows on the server", hint)
    now_ns = fleet.clock.wall_ns()
    from_ns, _ = robot_span_ns(fleet, robots[0], from_, "")
    state, is_new = fleet.following.start(model, now_ns if from_ns is None else from_ns, ahead_ns)
    if is_new:
        with fleet.database.begin() as connection:
            details = {"from": format_time(state.from_ns)}
            who.note(connection, now_ns, "models.follow", model.id, details=details)
    _publish(fleet, model)
    return _following(model.id, state)


def following_model(fleet: Services, who: Caller, model_id: str) -> FollowingModel:
    """Return what a model that follows has found; raises NotFoundError for any other one."""
    with fleet.database.reading() as connection:
        model = _find(connection, who, "models.read", model_id)
        _check_robots(connection, who, "data.query", model.wanted.robots)
    state = fleet.following.state(model.id)
    if state is None:
        raise NotFoundError(f"{model.name} version {model.version} does not follow its robots")
    return _following(model.id, state)


def following_models(
    fleet: Services, who: Caller, found: Sequence[LearntModel]
) -> dict[str, FollowingModel]:
    """Return what each of some models has found of those that follow, by its id."""
    with fleet.database.reading() as connection:
        mine = _robots(connection, who, "data.query")
    states = {
        one.id: fleet.following.state(one.id)
        for one in found
        if one.team and mine.issuperset(one.robots)
    }
    return {name: _following(name, state) for name, state in states.items() if state is not None}


def unfollow_model(fleet: Services, who: Caller, model_id: str) -> LearntModel:
    """Let a model follow no longer, and forget its alarms."""
    with fleet.database.begin() as connection:
        model = _find(connection, who, "models.write", model_id)
        who.note(connection, fleet.clock.wall_ns(), "models.unfollow", model.id)
    fleet.following.stop(model.id)
    _publish(fleet, model)
    return model_line(model)


def _following(model_id: str, state: FollowState) -> FollowingModel:
    return FollowingModel(
        model_id, format_time(state.from_ns), format_time(state.until_ns), state.error,
        [_alarm_line(alarm) for alarm in state.alarms],
    )  # fmt: skip


def _alarm_line(found: Mapping[str, Any]) -> DetectorAlarmLine:
    reason = found["reason"]
    return DetectorAlarmLine(
        found["robot"], found["id"], found["detector"], found["series"],
        format_time(found["onset_ns"]), format_time(found["confirmed_ns"]),
        maybe_time(found["gone_ns"]), found["score"], found["threshold"], found["p_value"],
        found["baseline"], reason["text"], dict(reason["contributions"]), reason["transitions"],
    )  # fmt: skip


def _team_options(given: Mapping[str, Any], robots: Sequence[str]) -> dict[str, Any]:
    """Return options in which each robot is a member with states of its own, if none is named.

    Raises UsageError for a single robot.
    """
    if len(robots) < 2:
        raise UsageError("a team has two robots at least")
    flow = given.get(_OF_TEAM, {})
    if isinstance(flow, Mapping) and not {"members", "variables"} & set(flow):
        flow = {**flow, "members": {robot: [f"{robot}/*"] for robot in robots}}
    return {**given, _OF_TEAM: flow}


def model_line(model: StoredModel) -> LearntModel:
    """Return a model in its published form."""
    wanted = model.wanted
    return LearntModel(
        model.id, model.name, model.version, model.owner, model.state, model.progress,
        wanted.robots, wanted.missions, maybe_time(wanted.from_ns), maybe_time(wanted.to_ns),
        wanted.detectors, wanted.team, wanted.false_alarms_per_hour,
        model.file if model.state == "done" else None, model.bytes, model.sha256, model.report,
        model.error, format_time(model.asked_ns), maybe_time(model.started_ns),
        maybe_time(model.ended_ns),
    )  # fmt: skip


def _publish(fleet: Services, model: StoredModel) -> None:
    fleet.bus.publish(ServerChange("job", "", {"id": model.id, "owner": model.owner}))


def _robots(connection: Connection, who: Caller, action: str) -> set[str]:
    return {robot.id for robot in who.robots(connection, action)}


def _check_robots(connection: Connection, who: Caller, action: str, robots: Sequence[str]) -> None:
    allowed = _robots(connection, who, action)
    for robot in robots:
        if robot not in allowed:
            raise NotFoundError(f"there is no robot {robot!r}, or not for you")


def _find(connection: Connection, who: Caller, action: str, model_id: str) -> StoredModel:
    model = models.find(connection, model_id)
    if model is None or not _robots(connection, who, action).issuperset(model.wanted.robots):
        raise NotFoundError("there is no such model, or not for you")
    return model
