"""Names in an Open-PSA model: what is private to a component, what everybody may use."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field

from amberbox.core.config import did_you_mean
from amberbox.core.errors import Problem
from amberbox.diagnosis.faulttree.xmltext import Element

Path = tuple[str, ...]
"""The fault tree and the components around an element."""

ID_ATTRIBUTE = "amberbox_id"
"""Attribute that keeps a name which the format does not allow."""

OTHER_FILES = "a model of several files is read when all are named: amberbox faulttree A.xml B.xml"

KINDS = {
    "define-gate": "gate",
    "define-basic-event": "basic event",
    "define-house-event": "house event",
    "define-parameter": "parameter",
}


@dataclass(frozen=True, slots=True)
class Definition:
    """One gate, event or parameter: its element, and the name by which the tree knows it."""

    name: str
    kind: str
    element: Element
    path: Path

    @property
    def label(self) -> str:
        """Return what people call it."""
        return next((child.text.strip() for child in self.element.of_tag("label")), "")


@dataclass
class Scope:
    """All definitions of a model by their full path, and the public ones by their bare name.

    Parameters (True) and what gates refer to (False) have names of their own. ``known`` holds
    what the tree will call each.
    """

    problems: list[Problem]
    by_path: dict[tuple[bool, Path], Definition] = field(default_factory=dict)
    public: dict[tuple[bool, str], Definition] = field(default_factory=dict)
    known: dict[tuple[bool, str], Definition] = field(default_factory=dict)

    def define(self, element: Element, path: Path, private: bool) -> None:
        """Add a definition."""
        kind, name = KINDS[element.tag], element.attributes.get("name", "")
        if not name:
            self.fail(element, f"<{element.tag}>", "has no name")
            return
        plain = ".".join((*path, name)) if private else name
        known_as = attribute(element, ID_ATTRIBUTE) or plain
        definition = Definition(known_as, kind, element, path)
        is_parameter = kind == "parameter"
        first = self.by_path.setdefault((is_parameter, (*path, name)), definition)
        first = first if first is not definition else self._first(definition, is_parameter)
        if not private and first is definition:
            first = self.public.setdefault((is_parameter, name), definition)
        if first is not definition:
            there = first.element
            place = "line " if there.file == element.file else f"{there.file}:"
            what = f"is defined twice, first in {place}{there.line}"
            self.fail(element, name, what)

    def of_kind(self, kind: str) -> Iterator[Definition]:
        """Yield the definitions of a kind in the order of the file."""
        return (entry for entry in self.by_path.values() if entry.kind == kind)

    def find(self, element: Element, path: Path, kinds: tuple[str, ...]) -> Definition | None:
        """Return what an element refers to; None and a problem if there is no such thing."""
        name = element.attributes.get("name", "")
        is_parameter = kinds == ("parameter",)
        found = self._lookup(is_parameter, name, path)
        if found is None:
            known = {entry for parameter, entry in self.public if parameter == is_parameter}
            hint = did_you_mean(name, known).removeprefix("; ") or OTHER_FILES
            self.fail(element, name or f"<{element.tag}>", f"no such {_either(kinds)}", hint)
        elif found.kind not in kinds:
            self.fail(element, name, f"is a {found.kind}, not a {_either(kinds)}")
            return None
        return found

    def fail(self, element: Element, where: str, what: str, hint: str = "") -> None:
        """Note a problem at an element."""
        self.problems.append(Problem(element.file, element.line, where, what, hint))

    def _first(self, definition: Definition, is_parameter: bool) -> Definition:
        return self.known.setdefault((is_parameter, definition.name), definition)

    def _lookup(self, is_parameter: bool, name: str, path: Path) -> Definition | None:
        """Look in the component itself, then in those around it, then at what is public."""
        steps = tuple(name.split("."))
        for depth in range(len(path), -1, -1):
            for full in ((*path[:depth], name), (*path[:depth], *steps)):
                if (is_parameter, full) in self.by_path:
                    return self.by_path[is_parameter, full]
        return self.public.get((is_parameter, name))


def attribute(element: Element, name: str) -> str:
    """Return one of the ``attributes`` of an element; empty if it has no such one."""
    for entries in element.of_tag("attributes"):
        for entry in entries.of_tag("attribute"):
            if entry.attributes.get("name") == name:
                return entry.attributes.get("value", "")
    return ""


def _either(kinds: tuple[str, ...]) -> str:
    return " or ".join(kinds)
