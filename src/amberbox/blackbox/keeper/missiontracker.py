"""Missions by rule: what edges of conditions begin and end."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace

from amberbox.blackbox.keeper.conditions import Condition, Conditions, Edge
from amberbox.blackbox.keeper.options import MissionRule
from amberbox.blackbox.missions.mission import DONE, SUPERSEDED, TIMEOUT, Mission, Moment
from amberbox.blackbox.query.clockbook import ClockBook
from amberbox.core.clock import NS
from amberbox.core.expression import Value, parse
from amberbox.core.ids import derive_id
from amberbox.core.timetext import format_time

WhenIs = Callable[[int], Moment]
"""Turns a time of the conditions into a moment of the record."""

RULE = "rule"
"""Who began the missions that rules find."""

_PARAMETER = "parameter "
_EVER_NS = 1 << 62


def conditions_of(rules: Sequence[MissionRule]) -> Conditions:
    """Compile what the rules watch; raises ExpressionError for what cannot be read."""
    found: dict[str, Condition] = {}
    for rule in rules:
        starts = {_PARAMETER + key: parse(text) for key, text in rule.parameters.items()}
        ends = {"failed": rule.failed, "outcome": rule.outcome}
        found[f"{rule.name}:end"] = Condition(
            parse(rule.end), {key: parse(text) for key, text in ends.items() if text}
        )
        found[f"{rule.name}:start"] = Condition(parse(rule.start), starts)
    return Conditions(found)


def id_of(name: str, from_ns: int) -> str:
    """Make the id of a mission out of its name and start, to the millisecond, UTC."""
    day, _, rest = format_time(from_ns)[:23].partition("T")
    return derive_id(f"{name}-{day.replace('-', '')}t{rest.replace(':', '')}")


class Tracker:
    """Knows which missions there are; edges and people begin and end them.

    ``book`` is asked where the clock may have been set since a mission began.
    """

    def __init__(
        self,
        rules: Sequence[MissionRule],
        known: Iterable[Mission] = (),
        book: Callable[[], ClockBook] = ClockBook,
    ) -> None:
        self._book = book
        self._rules = {rule.name: rule for rule in rules}
        self._known = {mission.id: mission for mission in known}

    @property
    def open(self) -> list[Mission]:
        """Return the missions that last, oldest first."""
        return [mission for mission in self._known.values() if mission.end is None]

    def start(self, mission: Mission) -> list[Mission]:
        """Begin a mission and end an open one of that name; return both as they are then.

        Nothing happens if it is known already.
        """
        if mission.id in self._known:
            return []
        before = [m for m in self.open if m.name == mission.name]
        changed = [self._ended(m, mission.start, SUPERSEDED, False) for m in before]
        self._known[mission.id] = mission
        return [*changed, mission]

    def end(
        self, mission: Mission, end: Moment, outcome: str, failed: bool | None = None
    ) -> list[Mission]:
        """End a mission that lasts; it cannot end before it began."""
        if self._known.get(mission.id) != mission or mission.end is not None:
            return []
        return [self._ended(mission, end, outcome, failed)]

    def take(self, edges: Iterable[Edge], when: WhenIs) -> list[Mission]:
        """Begin and end missions at edges of ``conditions_of``; return what changed, in order."""
        changed: list[Mission] = []
        for edge in edges:
            name, _, what = edge.name.rpartition(":")
            moment = when(edge.at_ns)
            changed += self.expire(moment)
            if what == "start":
                changed += self._begin(name, moment, edge)
            else:
                changed += self._finish(name, moment, edge)
        return changed

    def expire(self, now: Moment) -> list[Mission]:
        """End missions that have lasted for longer than their rule allows."""
        changed: list[Mission] = []
        for mission in self.open:
            rule = self._rules.get(mission.name)
            if mission.who == RULE and rule is not None and rule.max_s is not None:
                limit_ns = round(rule.max_s * NS)
                late_ns = self._since_ns(mission, now, limit_ns) - limit_ns
                if late_ns > 0:
                    changed += self.end(mission, _earlier(now, late_ns), TIMEOUT)
        return changed

    def _begin(self, name: str, moment: Moment, edge: Edge) -> list[Mission]:
        values = edge.values.items()
        parameters = {k.removeprefix(_PARAMETER): v for k, v in values if v is not None}
        mission_id = id_of(name, moment.received_ns)
        return self.start(Mission(mission_id, name, moment, who=RULE, parameters=parameters))

    def _finish(self, name: str, moment: Moment, edge: Edge) -> list[Mission]:
        changed: list[Mission] = []
        for mission in [m for m in self.open if m.name == name and m.who == RULE]:
            if self._since_ns(mission, moment, _EVER_NS) >= 0:
                outcome, failed = _judged(edge.values.get("outcome"), edge.values.get("failed"))
                changed += self.end(mission, moment, outcome, failed)
        return changed

    def _since_ns(self, mission: Mission, now: Moment, limit_ns: int) -> int:
        """Tell how long a mission has lasted; look twice where the clock may have been set."""
        since_ns = now.received_ns - mission.from_ns
        if 0 <= since_ns <= limit_ns:
            return since_ns
        book = self._book()
        return now.corrected_ns(book) - mission.start.corrected_ns(book)

    def _ended(self, mission: Mission, end: Moment, outcome: str, failed: bool | None) -> Mission:
        self._known[mission.id] = mission.ended(end, outcome, failed)
        return self._known[mission.id]


def _judged(outcome: Value, failed: Value) -> tuple[str, bool | None]:
    """Say how a mission ended: by its own word, else by whether it failed."""
    if outcome is None:
        return ("failed" if failed is True else DONE), failed is True
    text = outcome if isinstance(outcome, str) else f"{outcome}"
    return text, None if failed is None else failed is True


def _earlier(moment: Moment, by_ns: int) -> Moment:
    return replace(
        moment, received_ns=moment.received_ns - by_ns, log_ns=moment.log_ns - by_ns,
        boot_ns=moment.boot_ns - by_ns,
    )  # fmt: skip
