"""What an alarm is about, in words: its component, its cause, what happened to it."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field

from sqlalchemy import Connection

from amberbox.core.clock import NS
from amberbox.fleet.api.alarmlines import AlarmLine, Happening
from amberbox.fleet.knowledge import notebook
from amberbox.fleet.knowledge.explained import Answer
from amberbox.fleet.linkend.presence import presences
from amberbox.fleet.pages import wording
from amberbox.fleet.pages.diagnosis.card import card_of
from amberbox.fleet.pages.figures import span
from amberbox.fleet.pages.strings import catalogue
from amberbox.fleet.pages.wording import capital
from amberbox.fleet.services import Services

_SHELVED = re.compile(r"until (\d{4}-\d\d-\d\dT[\d:]+Z): (.*)", re.DOTALL)
_WORSE = re.compile(r"(\w+) -> (\w+)")
_OVER = "over"
_UNDESCRIBED = "not in the FMEA"
_FAULT = re.compile(r"([^\s#()]+)#([^\s#()]+)")
"""A component and how it fails, as robots name a cause."""


@dataclass(frozen=True, slots=True)
class Words:
    """What parts of robots are called, and the explanations that are known already."""

    fleet: Services
    folders: Mapping[str, str] = field(default_factory=dict)
    told: Mapping[tuple[str, str], Answer] = field(default_factory=dict)
    _names: dict[str, Mapping[str, str]] = field(default_factory=dict)

    def part(self, robot: str, component: str) -> str:
        """Return what a component is called."""
        if robot not in self._names:
            self._names[robot] = self._names_of(robot)
        return self._names[robot].get(component) or readable(component)

    def _names_of(self, robot: str) -> Mapping[str, str]:
        """Return what components are called that have a name beside their id."""
        facts = self.fleet.feed.state.cards.facts.known(robot, self.folders.get(robot, ""))
        named = facts.components if facts else ()
        return {one.id: capital(one.name) for one in named if one.name not in ("", one.id)}

    def what(self, line: AlarmLine) -> str:
        """Return what an alarm is about: a component, or what robots share that are away."""
        if line.kind == "robot":
            return self.part(line.window.robot, line.origin)
        return readable(line.origin)

    def cause(self, line: AlarmLine) -> str:
        """Return what the diagnosis says it comes from; empty where nobody knows."""
        if not line.cause:
            return ""
        answer = self.told.get((line.window.robot, line.diagnosis))
        return (_told(answer) if answer else "") or self.plain(line.window.robot, line.cause)

    def plain(self, robot: str, cause: str) -> str:
        """Return a robot's own words for a cause, with the names of its parts."""
        named = _FAULT.sub(lambda one: f"{self.part(robot, one[1])}: {one[2].replace('_', ' ')}",
                           cause)  # fmt: skip
        return named.replace(_UNDESCRIBED, catalogue().text("alarms.cause_other"))


def words_of(
    connection: Connection, fleet: Services, diagnoses: Iterable[tuple[str, str]]
) -> Words:
    """Return the words of all robots as their folders have them now, and of some diagnoses."""
    folders = {one.robot: one.config_hash for one in presences(connection)}
    told = {one: _explained(connection, fleet, *one) for one in set(diagnoses) if one[1]}
    return Words(fleet, folders, {one: answer for one, answer in told.items() if answer})


def _explained(
    connection: Connection, fleet: Services, robot: str, diagnosis: str
) -> Answer | None:
    """Return what is known of a diagnosis: by the last answer to a test, if that is not older."""
    found = fleet.explained.newest(robot, diagnosis)
    made = notebook.revisions(connection, robot, diagnosis)
    if made and (found is None or made[-1].body["revision"] >= found["revision"]):
        return made[-1].body
    return found


@dataclass(frozen=True, slots=True)
class Event:
    """A line of the history: what happened in words, what was said, until when it is shelved."""

    at: str
    who: str
    what: str
    text: str = ""
    until: str = ""


def events(history: list[Happening], words: Words, line: AlarmLine) -> Iterator[Event]:
    """Yield the history of an alarm in words, the newest first."""
    for one in reversed(history):
        text, until = _said(one, words, line)
        yield Event(one.at, one.who, _what(one), text, until)


def lasted_ns(from_ns: int, to_ns: int) -> str:
    """Write how long it is from one time to another."""
    return span((to_ns - from_ns) / NS)


def readable(name: str) -> str:
    """Write an id as people write a name: ``laser_front`` is "Laser front"."""
    return capital(wording.readable(name)) or name


def _told(answer: Answer) -> str:
    """Return the leading causes of an answer, with how sure it is."""
    card = card_of(answer)
    text = catalogue().text
    names = [text(f"diagnosis.card.{one.kind}") if one.kind != "fault" else one.text
             for one in card.causes]  # fmt: skip
    if len(names) > 1:
        return text("alarms.cause_one_of", names=text("alarms.or").join(names), share=card.number)
    return text("alarms.cause_sure", name=names[0], share=card.number) if names else ""


def _what(one: Happening) -> str:
    texts = catalogue().texts
    key = f"alarms.event.{one.what}"
    own = f"{key}_by_itself" if not one.who else ""
    return texts.get(own) or texts.get(key) or one.what


def _said(one: Happening, words: Words, line: AlarmLine) -> tuple[str, str]:
    """Return the text of a line as people read it, and until when an alarm is shelved."""
    text = catalogue().text
    shelved, worse = _SHELVED.fullmatch(one.text), _WORSE.fullmatch(one.text)
    if one.what == "shelved" and shelved:
        return shelved[2], shelved[1]
    if one.what == "worse" and worse and worse[2] in ("warning", "urgent", "critical", "fatal"):
        return text(f"words.severity_{worse[2]}.name"), ""
    if one.what == "cause":
        return words.plain(line.window.robot, one.text) if one.text else "", ""
    if one.what == "notified":
        return text("alarms.event.notified_as", severity=one.text), ""
    if one.what == "resolved" and not one.who:
        return one.text.removeprefix(_OVER).removeprefix(", "), ""
    return one.text, ""
