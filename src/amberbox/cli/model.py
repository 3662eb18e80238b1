"""Models of detectors on a server: list, save, install, run over recordings, follow, delete."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import msgspec

from amberbox.cli._arguments import add_actions, add_range_only, check_time
from amberbox.cli._output import print_grid, print_json, progress_bar
from amberbox.cli.fleet_command import announced_actions, send
from amberbox.client.address import is_url, read_address
from amberbox.core.command import MODEL_INSTALL
from amberbox.core.errors import AmberboxError, UsageError, did_you_mean
from amberbox.core.units import bytes_text

if TYPE_CHECKING:
    from amberbox.client.fleet import Fleet
    from amberbox.client.models import DetectorAlarmLine, FollowingModel, LearntModel

_USAGE = (
    "amberbox model [list] URL | get URL NAME[:VERSION] -o FILE | "
    "install URL NAME[:VERSION] [--key NAME] [--wait] [--intent] | "
    "detect URL NAME[:VERSION] --from T --to T | follow URL NAME[:VERSION] [--from T] | "
    "unfollow URL NAME[:VERSION] | delete URL NAME:VERSION [--json]"
)
_RANGES = {"detect": ((True, True),), "follow": ((False, False), (True, False))}
"""Which of --from and --to an action takes, together; any other one takes none."""
_HEADER = ("name", "version", "state", "robots", "detectors", "size", "asked (UTC)", "who")


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the verb's arguments."""
    parser.usage = _USAGE
    of_one = ("get", "install", "detect", "follow", "unfollow", "delete")
    words: dict[str, Sequence[str]] = {"list": (), **dict.fromkeys(of_one, ("MODEL",))}
    place = "https://host:port of the server; then NAME:VERSION of a model, or its id"
    add_actions(parser, words, "list", place)
    add_range_only(parser)
    parser.add_argument("-o", "--output", metavar="FILE", help="where get saves the model file")
    parser.add_argument("--key", default="", metavar="NAME", help="the key to sign install with")
    parser.add_argument("--wait", action="store_true", help="wait until the robot is there and "
                        "free; with --intent until it is done")  # fmt: skip
    parser.add_argument("--intent", action="store_true", help="store install unsigned: somebody "
                        "signs it with 'amberbox sign'")  # fmt: skip
    parser.add_argument("--json", action="store_true", help="print JSON")
    parser.set_defaults(run="", ttl="20s", yes=True)


def run(args: argparse.Namespace) -> int:
    """List, save, install, detect, follow or delete."""
    if not is_url(args.where):
        raise UsageError(f"{args.where} is no address of a server", _USAGE)
    if len(args.rest) != (args.action != "list") or bool(args.output) != (args.action == "get"):
        raise UsageError(f"this is no {args.action}", _USAGE)
    if (bool(args.from_), bool(args.to)) not in _RANGES.get(args.action, ((False, False),)):
        raise UsageError("--from and --to are the range of detect, --from that of follow", _USAGE)
    for option in ("from_", "to"):
        check_time(f"--{option.strip('_')}", getattr(args, option))
    from amberbox.client.fleet import Fleet

    with Fleet(args.where) as fleet:
        if args.action == "list":
            _list(fleet.learnt_models(), as_json=args.json)
            return 0
        return _do(args, fleet, _named(fleet, args.rest[0]))


def _do(args: argparse.Namespace, fleet: Fleet, model: LearntModel) -> int:
    """Do what is asked with one model."""
    match args.action:
        case "get":
            _get(fleet, model, Path(args.output), as_json=args.json)
        case "install":
            return _install(args, fleet, model)
        case "detect":
            robot = read_address(args.where).robot
            _detect(fleet.detect(model.id, args.from_, args.to, [robot] if robot else []), args)
        case "follow":
            _follow(fleet.follow_model(model.id, args.from_ or None), model, args)
        case "unfollow":
            _unfollow(fleet, model, as_json=args.json)
        case _:
            _delete(fleet, model, args.rest[0], as_json=args.json)
    return 0


def _list(models: list[LearntModel], *, as_json: bool) -> None:
    if as_json:
        print_json([msgspec.to_builtins(model) for model in models])
        return
    print_grid(_HEADER, [
        [
            one.name, str(one.version), one.state, ",".join(one.robots), ",".join(one.detectors),
            bytes_text(one.bytes) if one.bytes else "-", one.asked[:19], one.owner,
        ]
        for one in models
    ])  # fmt: skip


def _get(fleet: Fleet, model: LearntModel, target: Path, *, as_json: bool) -> None:
    saved = fleet.save_model(model.id, target, progress_bar(wanted=not as_json))
    if as_json:
        print_json({**msgspec.to_builtins(model), "saved": str(saved)})
    else:
        print(f"{saved}: {model.name} version {model.version}, sha256 {model.sha256}")


def _install(args: argparse.Namespace, fleet: Fleet, model: LearntModel) -> int:
    """Let a person sign that a robot installs a model; return the exit status."""
    robot = read_address(args.where).robot
    if not robot:
        raise UsageError("install takes the address of a robot", _USAGE)
    if model.state != "done" or model.team:
        what = "of a team, which only the server runs" if model.team else model.state
        raise AmberboxError(f"{model.name} version {model.version} is {what}")
    if MODEL_INSTALL not in announced_actions(fleet.actions(robot)):
        hint = "write from_server: yes below detection: in its robot.yaml"
        raise AmberboxError(f"{robot} takes no models of its server", hint)
    words = [f"sha256={model.sha256}", f"model={model.name} version {model.version}"]
    return send(args, fleet, robot, MODEL_INSTALL, words)


def _follow(found: FollowingModel, model: LearntModel, args: argparse.Namespace) -> None:
    if args.json:
        print_json(msgspec.to_builtins(found))
        return
    print(f"{model.name} version {model.version} follows {', '.join(model.robots)}, "
          f"from {found.from_[:19]} to {found.to[:19]} so far")  # fmt: skip
    if found.error:
        print(f"it does not go on: {found.error}")
    _print_alarms(found.alarms)


def _unfollow(fleet: Fleet, model: LearntModel, *, as_json: bool) -> None:
    found = fleet.unfollow_model(model.id)
    if as_json:
        print_json(msgspec.to_builtins(found))
    else:
        print(f"{model.name} version {model.version} follows no longer")


def _detect(alarms: Sequence[DetectorAlarmLine], args: argparse.Namespace) -> None:
    if args.json:
        print_json([msgspec.to_builtins(alarm) for alarm in alarms])
        return
    _print_alarms(alarms)


def _print_alarms(alarms: Sequence[DetectorAlarmLine]) -> None:
    for one in alarms:
        until = f" until {one.gone}" if one.gone else ""
        print(f"{one.confirmed[:23]}{until}  {one.robot or 'team'}  {one.id}: {one.reason}")
    if not alarms:
        print("no alarm")


def _delete(fleet: Fleet, model: LearntModel, named: str, *, as_json: bool) -> None:
    if named not in (model.id, f"{model.name}:{model.version}"):
        raise UsageError("name the version to delete", f"{model.name}:{model.version}")
    found = fleet.delete_model(model.id)
    if as_json:
        print_json(msgspec.to_builtins(found))
    else:
        print(f"deleted {model.name} version {model.version}")


def _named(fleet: Fleet, text: str) -> LearntModel:
    """Return the model ``NAME:VERSION`` or of an id; without a version the newest that is done."""
    models = fleet.learnt_models()
    name, _, version = text.partition(":")
    fitting = [one for one in models if text == one.id or name == one.name]
    if not fitting:
        known = sorted({one.name for one in models})
        hint = f"known: {', '.join(known) or 'none'}"
        raise UsageError(f"there is no model '{text}'{did_you_mean(name, known)}", hint)
    if version or text == fitting[0].id:
        chosen = [one for one in fitting if text == one.id or str(one.version) == version]
    else:
        chosen = [one for one in fitting if one.state == "done"]
    if not chosen:
        versions = ", ".join(f"{one.version} ({one.state})" for one in fitting)
        raise AmberboxError(f"there is no such version of '{name}'", f"versions: {versions}")
    return max(chosen, key=lambda one: one.version)
