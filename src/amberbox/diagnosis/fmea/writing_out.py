"""Write types out: once per instance, with ``<component>`` and other parameters filled in."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace

from amberbox.core.config import did_you_mean
from amberbox.core.errors import Problem
from amberbox.core.ids import is_id
from amberbox.core.nodes import Node

_PARAMETER = re.compile(r"<([a-z_][a-z0-9_]*)>")


@dataclass(frozen=True, slots=True)
class Instance:
    """A component with the node of its type, parameters filled in."""

    component: str
    type: str
    node: Node


def instances(root: Node, problems: list[Problem]) -> list[Instance]:
    """Return all components; a type that ``instances`` does not name is its own only one."""
    types = _mapping(root, "types", problems)
    given = _mapping(root, "instances", problems)
    for name, node in given.items():
        if name not in types:
            what = f"there is no type '{name}'{did_you_mean(name, types)}"
            problems.append(node.problem("instances", what))
    found: list[Instance] = []
    for name, node in types.items():
        found += _of_type(name, node, given.get(name), problems)
    return _each_once(found, problems)


def _mapping(root: Node, key: str, problems: list[Problem]) -> Mapping[str, Node]:
    node = (root.mapping or {}).get(key)
    if node is None or node.value is None:
        return {}
    if node.mapping is None:
        what = f"expected a mapping (key: value), got {node.kind}"
        problems.append(node.problem(key, what))
    return node.mapping or {}


def _of_type(
    name: str, node: Node, given: Node | None, problems: list[Problem]
) -> Iterator[Instance]:
    for component, place, parameters in _named(name, node, given, problems):
        if not is_id(component):
            what = f"'{component}' is no id: a-z 0-9 _ . - only"
            problems.append(place.problem(f"instances.{name}", what))
            continue
        values = {"component": component, **parameters}
        yield Instance(component, name, _filled(node, values, f"types.{name}", problems))


def _named(
    name: str, node: Node, given: Node | None, problems: list[Problem]
) -> Iterator[tuple[str, Node, Mapping[str, str]]]:
    """Yield the components of a type: a list of names, or names with their parameters."""
    if given is None:
        yield name, node, {}
    elif given.items is not None:
        for entry in given.items:
            yield entry.text, entry, {}
    elif given.mapping is not None:
        for component, entry in given.mapping.items():
            yield component, entry, {k: v.text for k, v in (entry.mapping or {}).items()}
    else:
        what = "expected a list of names, or names with parameters"
        problems.append(given.problem(f"instances.{name}", what))


def _each_once(found: list[Instance], problems: list[Problem]) -> list[Instance]:
    """Keep the first of several components with one name."""
    kept: dict[str, Instance] = {}
    for entry in found:
        first = kept.setdefault(entry.component, entry)
        if first is not entry:
            what = f"the component '{entry.component}' is there already, as {first.type}"
            problems.append(entry.node.problem(f"types.{entry.type}", what))
    return list(kept.values())


def _filled(node: Node, values: Mapping[str, str], where: str, problems: list[Problem]) -> Node:
    """Return a copy of a tree with the parameters filled in."""
    if node.items is not None:
        return replace(node, value=tuple(_filled(n, values, where, problems) for n in node.items))
    if node.mapping is not None:
        entries = {
            _text(key, entry, values, where, problems): _filled(entry, values, where, problems)
            for key, entry in node.mapping.items()
        }
        return replace(node, value=entries)
    if not isinstance(node.value, str) or "<" not in node.value:
        return node
    text = _text(node.value, node, values, where, problems)
    return replace(node, value=text, text=text)


def _text(
    text: str, node: Node, values: Mapping[str, str], where: str, problems: list[Problem]
) -> str:
    def value(match: re.Match[str]) -> str:
        if match[1] not in values:
            what = f"there is no parameter <{match[1]}>{did_you_mean(match[1], values)}"
            problems.append(node.problem(where, what, f"known: {', '.join(values)}"))
        return values.get(match[1], match[0])

    return _PARAMETER.sub(value, text)
