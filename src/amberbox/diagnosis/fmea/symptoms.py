"""Symptoms of the file: addresses of outputs, names, conditions; each resolved once."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace

from amberbox.core.config import did_you_mean
from amberbox.core.errors import AmberboxError, Problem
from amberbox.core.expression import Expression
from amberbox.core.nodes import Node
from amberbox.diagnosis.fmea.file import DefaultsFile, LinkFile, SymptomFile
from amberbox.diagnosis.fmea.known import Known
from amberbox.diagnosis.fmea.model import Link, Symptom
from amberbox.diagnosis.fmea.places import child


class Symptoms:
    """Collects the symptoms that something links to, and those that the file names."""

    def __init__(
        self, defaults: DefaultsFile, known: Known | None, problems: list[Problem]
    ) -> None:
        self._defaults = defaults
        self._named: dict[str, SymptomFile] = {}
        self._known = known
        self._problems = problems
        self.found: dict[str, Symptom] = {}

    def links(
        self, entries: Sequence[str | LinkFile], node: Node, where: str, owner: str
    ) -> tuple[Link, ...]:
        """Return the links of a cause; ``node`` is the list in the file.

        ``owner`` is the id of the cause: ``component#mode`` may use names of its component.
        """
        found = []
        for place, entry in enumerate(entries):
            at = f"{where}[{place}]"
            link = entry if isinstance(entry, LinkFile) else LinkFile(entry)
            symptom = self._symptom(link, child(node, place), at, f"{owner}.{place}")
            if symptom is not None:
                found.append(self._link(symptom, link))
        self._tell_twice(found, node, where)
        return tuple(link for link in found if link.detects > 0)

    def address(self, text: str, node: Node, where: str) -> str | None:
        """Return the address of an output as monitors have it, or tell that there is none."""
        if self._known is None or text in self._known.outputs:
            return text
        near = did_you_mean(text, self._known.outputs)
        self._problems.append(node.problem(where, f"there is no output '{text}'{near}"))
        return None

    def _symptom(self, link: LinkFile, node: Node, where: str, name: str) -> Symptom | None:
        if link.when is not None:
            when = self._condition(link.when, child(node, "when"), where)
            made = Symptom(name, when, self._defaults.leak)
            return self.found.setdefault(name, made) if when is not None else None
        for text in (f"{name.partition('#')[0]}.{link.symptom}", link.symptom):
            if text in self.found and self.found[text].condition is not None:
                return self.found[text]
        return self._output(link.symptom, child(node, "symptom"), where)

    def _output(self, text: str, node: Node, where: str) -> Symptom | None:
        known = self._known
        if known is not None and text not in known.outputs:
            candidates = [*known.watched, *self._named]
            what = f"there is no symptom '{text}'{did_you_mean(text, candidates)}"
            hint = "write COMPONENT/MODE/OUTPUT of a monitor, or a name under 'symptoms'"
            self._problems.append(node.problem(where, what, hint))
            return None
        if known is not None and text not in known.watched:
            what = f"nothing is expected of '{text}', so that it is never bad"
            hint = "give the output 'expected', or write a condition: {when: ...}"
            self._problems.append(node.problem(where, what, hint))
            return None
        if known is None and text.count("/") != 2 and text not in self._named:
            what = f"there is no symptom '{text}'{did_you_mean(text, self._named)}"
            self._problems.append(node.problem(where, what))
            return None
        return self.found.setdefault(text, Symptom(text, None, self._defaults.leak))

    def _link(self, symptom: Symptom, link: LinkFile) -> Link:
        """Make the link; a symptom waits as long as the slowest of its links."""
        default = self._defaults
        named = self._named.get(symptom.id)
        detects = default.detects if link.detects is None else link.detects
        within_s = _first(link.within_s, named.within_s if named else None, default.within_s)
        hold_s = _first(link.hold_s, named.hold_s if named else None, default.hold_s)
        self.found[symptom.id] = replace(
            symptom,
            within_s=max(symptom.within_s, within_s),
            hold_s=max(symptom.hold_s, hold_s),
        )
        return Link(symptom.id, detects, within_s, hold_s)

    def _made(self, name: str, entry: SymptomFile) -> Symptom:
        leak = _first(entry.leak, None, self._defaults.leak)
        within_s, hold_s = entry.within_s or 0.0, entry.hold_s or 0.0
        return Symptom(name, entry.when, leak, within_s, hold_s, entry.description, entry.by_itself)

    def add(
        self, entries: Mapping[str, SymptomFile], node: Node, where: str, component: str = ""
    ) -> None:
        """Take symptoms with a name or address; a component's names are ``component.name``.

        Tells which are neither an output nor have a condition, and resolves conditions.
        """
        for short, entry in entries.items():
            place = child(node, short)
            name = f"{component}.{short}" if component and "/" not in short else short
            self._named[name] = entry
            self.found[name] = self._made(name, entry)
            self._judge(name, entry, place, f"{where}.{short}")

    def _judge(self, name: str, entry: SymptomFile, place: Node, where: str) -> None:
        if entry.when is None:
            self.address(name, place, where)
            return
        when = self._condition(entry.when, child(place, "when"), f"{where}.when")
        self.found[name] = replace(self.found[name], condition=when or entry.when)

    def _condition(self, when: Expression, node: Node, where: str) -> Expression | None:
        if when.kind not in ("condition", "any"):
            self._problems.append(node.problem(where, "is no condition: it is never true or false"))
            return None
        addresses = self._known.addresses if self._known else None
        if addresses is None:
            return when
        try:
            return when.resolve(addresses)
        except AmberboxError as error:
            self._problems.append(node.problem(where, error.what, error.hint))
            return None

    def _tell_twice(self, links: Sequence[Link], node: Node, where: str) -> None:
        for symptom in _twice(link.symptom for link in links):
            self._problems.append(node.problem(where, f"'{symptom}' is there twice"))


def _first(value: float | None, other: float | None, default: float) -> float:
    if value is not None:
        return value
    return default if other is None else other


def _twice(names: Iterator[str]) -> Iterator[str]:
    seen: set[str] = set()
    for name in names:
        if name in seen:
            yield name
        seen.add(name)
