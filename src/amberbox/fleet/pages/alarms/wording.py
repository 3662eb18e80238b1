"""What an alarm is about, in words: its component, its cause, what happened to it."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field

from sqlalchemy import Connection

from amberbox.core.clock import NS
from amberbox.core.sureness import LIKELY, SURE_WORDS, percent
from amberbox.fleet.alarms.offline import CONNECTION
from amberbox.fleet.api.alarmlines import AlarmLine, Happening
from amberbox.fleet.linkend.presence import presences
from amberbox.fleet.pages import wording
from amberbox.fleet.pages.figures import span
from amberbox.fleet.pages.strings import catalogue
from amberbox.fleet.pages.wording import capital
from amberbox.fleet.services import Services
from amberbox.monitoring.engine.outputs import SEVERITIES

_SHELVED = re.compile(r"until (\d{4}-\d\d-\d\dT[\d:]+Z): (.*)", re.DOTALL)
_WORSE = re.compile(r"(\w+) -> (\w+)")
_OVER = "over"
_UNDESCRIBED = "not in the FMEA"
_NAMED = 2
"""So many causes are named where nothing tells them apart."""
_NO_FAULTS = ("false_alarm", "other")
_LIKELY = tuple(word for least, word in SURE_WORDS if least >= LIKELY)
_SURE = re.compile(rf" \(({'|'.join(word for _, word in SURE_WORDS)})\)$")
_CHECK = re.compile(r"(?:^|; )(?:not confirmed yet: )?([A-Za-z]\w*) (?:is|was|flapping)\b")
"""A check that a robot's reason names; what follows is its value."""
_FAULT = re.compile(r"([^\s#()]+)#([^\s#()]+)")
"""A component and how it fails, as robots name a cause."""


@dataclass(frozen=True, slots=True)
class Words:
    """What parts of robots are called."""

    fleet: Services
    folders: Mapping[str, str] = field(default_factory=dict)
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

    def title(self, line: AlarmLine) -> str:
        """Return what is wrong in one line: the cause where one is known, else which checks fail.

        The robot's own words are kept for what is small below.
        """
        causes = line.explained.causes if line.explained else ()
        if causes and all(one.kind == "fault" for one in causes):
            return _either([capital(one.text) for one in causes])
        if line.kind == "robot":
            return checks_fail(self.what(line), line.reason)
        if not line.reason:
            return self.what(line)
        return line.reason if line.origin == CONNECTION else f"{self.what(line)}: {line.reason}"

    def cause(self, line: AlarmLine) -> str:
        """Return what the diagnosis says it comes from; empty where nobody knows."""
        if line.explained is None or not line.explained.causes:
            return self.plain(line, line.cause) if line.cause else ""
        said = line.explained
        kinds = {kind: catalogue().text(f"diagnosis.card.{kind}") for kind in _NO_FAULTS}
        names = [kinds.get(one.kind) or capital(one.text) for one in said.causes]
        word = sure_word(len(names), said.probability)
        return catalogue().text("alarms.cause_sure", name=_either(names), word=word,
                                share=percent(said.probability))  # fmt: skip

    def plain(self, line: AlarmLine, cause: str) -> str:
        """Return a robot's own words for a cause, with the names of its parts and failures."""
        robot, known = line.window.robot, line.explained.names if line.explained else {}

        def named(found: re.Match[str]) -> str:
            text = known.get(found[0])
            return text or f"{self.part(robot, found[1])}: {found[2].replace('_', ' ')}"

        told = _FAULT.sub(named, cause).replace(
            _UNDESCRIBED, catalogue().text("alarms.cause_other")
        )
        sure = _SURE.search(told)
        if sure is None:
            return capital(told)
        count = cause.count(" or ") + 1
        word = sure_word(count, 1.0 if sure[1] in _LIKELY else 0.0)
        return capital(f"{told[: sure.start()]} ({word})")


def sure_word(count: int, probability: float) -> str:
    """Say how sure an answer is, in the words of the card: of one cause, or of several."""
    if count > 1:
        return catalogue().text("alarms.sure.cannot_tell_apart")
    return catalogue().text(
        "alarms.sure.likely" if probability >= LIKELY else "alarms.sure.possible"
    )


def checks_fail(what: str, reason: str) -> str:
    """Say which checks of a part fail, by the robot's own words; those words where none says."""
    names = list(dict.fromkeys(readable(name).lower() for name in _CHECK.findall(reason)))
    if not names:
        return f"{what}: {reason}" if reason else what
    text, quoted = catalogue().text, [catalogue().text("alarms.quoted", text=n) for n in names]
    if len(names) == 1:
        return text("alarms.check_fails", what=what, name=quoted[0])
    if len(names) == 2:
        return text("alarms.checks_fail", what=what, one=quoted[0], other=quoted[1])
    return text("alarms.many_fail", what=what, one=quoted[0], n=len(names) - 1)


def plain_cause(cause: str) -> str:
    """Say what is wrong with a robot, of which a card says "component: reason"."""
    component, colon, reason = cause.partition(": ")
    return checks_fail(capital(wording.readable(component)), reason) if colon else cause


def words_of(connection: Connection, fleet: Services) -> Words:
    """Return the words of all robots as their folders have them now."""
    return Words(fleet, {one.robot: one.config_hash for one in presences(connection)})


def _either(names: Sequence[str]) -> str:
    """Name the first of several, of which one is meant; the others begin in small letters."""
    text = catalogue().text
    first, *more = names
    if len(names) > _NAMED:
        return text("alarms.or_others", name=first, n=len(names) - 1)
    return text("alarms.or").join([first, *(one[:1].lower() + one[1:] for one in more)])


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
    if one.what in ("worse", "effect") and worse and worse[2] in SEVERITIES:
        return text(f"words.severity_{worse[2]}.name"), ""
    if one.what == "cause":
        return words.plain(line, one.text) if one.text else "", ""
    if one.what == "notified":
        return text("alarms.event.notified_as", severity=one.text), ""
    if one.what == "resolved" and not one.who:
        return one.text.removeprefix(_OVER).removeprefix(", "), ""
    return one.text, ""
