"""Members of a team: what is lost of a robot is a failure mode one level up."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path

from amberbox.core.config import did_you_mean
from amberbox.core.nodes import Node, load_yaml
from amberbox.diagnosis.fmea.entries import Scope, with_ranks
from amberbox.diagnosis.fmea.file import MemberFile, MemberFunctionFile, RanksFile
from amberbox.diagnosis.fmea.model import Component, FailureMode
from amberbox.diagnosis.fmea.places import child
from amberbox.diagnosis.fmea.reading import rate_notes

LOST = "lost"
"""Name of the failure mode of a member's function."""


def folders(robots: Mapping[str, MemberFile], folder: Path) -> dict[str, str]:
    """Return where each robot's folder is, for those of which the file says it."""
    paths = {robot: folder / member.where for robot, member in robots.items() if member.where}
    places = {name: p.parent if p.suffix == ".yaml" else p for name, p in paths.items()}
    return {name: os.path.normpath(place) for name, place in places.items()}


def members(
    robots: Mapping[str, MemberFile], root: Node, scope: Scope, folder: Path
) -> dict[str, Component]:
    """Return a component ``robot:function`` for each function that the team wants of a robot."""
    found: dict[str, Component] = {}
    for robot, member in robots.items():
        node = child(root, "robots", robot)
        offered = _offered(member, node, scope, folder)
        for name, entry in member.functions.items():
            place = child(node, "functions", name)
            where = f"robots.{robot}.functions.{name}"
            if offered is not None and name not in offered:
                what = f"{robot} has no function '{name}'{did_you_mean(name, offered)}"
                scope.problems.append(place.problem(where, what))
            component, words = f"{robot}:{name}", (offered or {}).get(name) or name
            text = f"the robot {robot} cannot: {words}"
            _lost(component, text, entry, place, where, scope)
            found[component] = Component(component, "robot", modes=(f"{component}#{LOST}",))
    return found


def _offered(member: MemberFile, node: Node, scope: Scope, folder: Path) -> dict[str, str] | None:
    """Return the functions in the robot's own file, described; None if that is not there (yet)."""
    path = folder / member.where
    path = path / "fmea.yaml" if path.is_dir() else path
    if not member.where or not path.is_file():
        if member.where:
            what = f"{member.where} is not there yet: its functions are not compared"
            scope.problems.append(child(node, "where").problem("where", what, is_error=False))
        return None
    root = load_yaml(path, scope.problems)
    functions = (root.mapping or {}).get("functions") if root else None
    found = (functions.mapping or {}) if functions else {}
    return {name: _description(function) for name, function in found.items()}


def _description(function: Node) -> str:
    described = (function.mapping or {}).get("description")
    return str(described.value) if described else ""


def _lost(
    component: str,
    text: str,
    entry: MemberFunctionFile,
    node: Node,
    where: str,
    scope: Scope,
) -> None:
    mode_id = f"{component}#{LOST}"
    place = child(node, "symptoms")
    links = scope.symptoms.links(entry.symptoms, place, f"{where}.symptoms", mode_id)
    if (entry.rate is None) == (entry.probability is None):
        scope.problems.append(node.problem(where, "how probable is it? give probability or rate"))
    for key, what in entry.wrong():
        scope.problems.append(child(node, key).problem(f"{where}.{key}", what))
    scope.problems.extend(rate_notes(entry.rate, node, where))
    mode = FailureMode(
        mode_id, component, LOST, text,
        severity=entry.severity, rate=entry.rate, probability=entry.probability,
        exposure_h=scope.file.exposure_h, symptoms=links, unobservable=entry.unobservable,
        remedy=entry.remedy, line=node.line, make_safe=entry.make_safe,
    )  # fmt: skip
    scope.modes[mode_id] = with_ranks(mode, RanksFile(), scope.file.scales)
