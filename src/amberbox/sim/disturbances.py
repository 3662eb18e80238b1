"""Disturbances of a stream of messages: values or times that are wrong after they left their part.

Faults of ``faults.py`` change the physics of the simulated robot; a disturbance changes what is
received of any robot: its input are the messages of the simulation, or rows of a record.
"""

from __future__ import annotations

import copy
import heapq
import math
import numbers
import random
import re
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, TypeAlias

import numpy as np

from amberbox.core.clock import NS
from amberbox.core.config import build, raise_errors
from amberbox.core.errors import Problem, UsageError, did_you_mean
from amberbox.core.options import option
from amberbox.core.units import parse_duration_s
from amberbox.core.yaml_nodes import load_yaml
from amberbox.sim.topics import TOPICS, leaves

Message: TypeAlias = tuple[str, int, dict[str, Any]]
"""Item, time in ns, and its fields: nested as in a message, or flat as in a row of a record."""
KindName = Literal[
    "swap",
    "scale",
    "offset",
    "drift",
    "sign",
    "mirror",
    "unit",
    "quantise",
    "freeze",
    "delay",
    "jitter",
    "drop",
    "repeat",
]
Reach = Literal["variable", "item", "both"]
_AFTER_NS = 1000  # between a message and its repetition
_INT64 = np.iinfo(np.int64)
_STEP = re.compile(r"([^\[\]]+)|\[(\d{1,9})\]")
_TEXT = re.compile(
    r"(?P<kind>\w+):(?P<item>[^.=@]+)(?:\.(?P<variable>[^=@]+))?(?:=(?P<value>[^@]+))?"
    r"(?:@(?P<at>.+?)(?:\.\.(?P<until>.+))?)?"
)
_FORM = "KIND:ITEM[.VARIABLE][=AMOUNT, VARIABLE or CONVERSION][@20s[..40s]]"


@dataclass(frozen=True, slots=True)
class KindFacts:
    """One kind of disturbance: what it disturbs, and its amount with unit, default and range.

    ``reach`` is what it acts on: a variable, all messages of an item, or either. ``unit`` is empty
    if the kind has no amount; without ``default`` the amount may be absent.
    """

    reach: Reach
    description: str
    unit: str = ""
    default: float | None = None
    low: float = -math.inf
    high: float = math.inf


KINDS: Mapping[KindName, KindFacts] = {
    "swap": KindFacts("variable", "The variable and the one named by `other` are exchanged."),
    "scale": KindFacts("variable", "The value is multiplied.", "factor", 2.0),
    "offset": KindFacts("variable", "Something is added to the value.", "of the variable", 1.0),
    "drift": KindFacts("variable", "The value runs away, by so much a second.", "1/s", 0.1),
    "sign": KindFacts("variable", "The value has the opposite sign."),
    "mirror": KindFacts(
        "variable",
        "The value is reflected about the amount, if absent about its value at the beginning; "
        "a list is reversed.",
        "of the variable",
    ),
    "unit": KindFacts("variable", "The value is in another unit, see `conversion`."),
    "quantise": KindFacts(
        "variable", "The value is rounded to steps.", "of the variable", 1.0, 1e-12
    ),
    "freeze": KindFacts("variable", "The value stays as it was before; stamps go on."),
    "delay": KindFacts(
        "both",
        "Messages come later; with a variable only its value is old, in a message that is on time.",
        "s",
        0.4,
        0.0,
        3600.0,
    ),
    "jitter": KindFacts(
        "item",
        "Each message comes later, by up to so much; they stay in order.",
        "s",
        0.2,
        0.0,
        3600.0,
    ),
    "drop": KindFacts("item", "Messages are lost.", "share", 1.0, 0.0, 1.0),
    "repeat": KindFacts("item", "Each message comes again, so many times.", "times", 1, 1, 100),
}
"""The kinds of disturbances by name."""


@dataclass(frozen=True, slots=True)
class Conversion:
    """A confusion of units: value x factor + add."""

    unit: str
    factor: float
    add: float = 0.0


CONVERSIONS: Mapping[str, Conversion] = {
    "rad_to_deg": Conversion("rad", 180 / math.pi),
    "deg_to_rad": Conversion("deg", math.pi / 180),
    "rad_s_to_deg_s": Conversion("rad/s", 180 / math.pi),
    "rad_s_to_rpm": Conversion("rad/s", 30 / math.pi),
    "celsius_to_fahrenheit": Conversion("°C", 1.8, 32.0),
    "celsius_to_kelvin": Conversion("°C", 1.0, 273.15),
    "fahrenheit_to_celsius": Conversion("°F", 1 / 1.8, -32 / 1.8),
    "m_to_mm": Conversion("m", 1000.0),
    "m_to_cm": Conversion("m", 100.0),
    "m_to_feet": Conversion("m", 1 / 0.3048),
    "mm_to_m": Conversion("mm", 0.001),
    "m_s_to_km_h": Conversion("m/s", 3.6),
    "m_s2_to_g": Conversion("m/s^2", 1 / 9.80665),
    "volt_to_millivolt": Conversion("V", 1000.0),
    "ampere_to_milliampere": Conversion("A", 1000.0),
    "percent_to_share": Conversion("%", 0.01),
    "hpa_to_pa": Conversion("hPa", 100.0),
    "s_to_ms": Conversion("s", 1000.0),
    "ms_to_s": Conversion("ms", 0.001),
    "us_to_ms": Conversion("us", 0.001),
    "mb_to_gb": Conversion("MB", 0.001),
    "mbit_to_mbyte": Conversion("Mbit/s", 0.125),
}
"""The confusions of units that ``unit`` knows, with the unit that the variable has."""


@dataclass(frozen=True)
class Disturbance:
    """One disturbance of an item or of one of its variables, from ``at_s`` until ``until_s``.

    ``variable`` is a path such as ``twist.linear.x`` or ``cell_voltage[3]``; all numbers below it
    are disturbed. Times are seconds since the start of the stream, by the time of the message.
    """

    kind: KindName = option(doc="kind of disturbance")
    item: str = option(doc="topic, or item of a record")
    variable: str = option("", "path of the variable in the message; with the kinds of items none")
    amount: float | None = option(None, "how much; the kind's default when absent")
    other: str = option("", "of swap: the other variable, of the same item")
    conversion: str = option("", "of unit: the confusion of units")
    at_s: float = option(0.0, "when it begins, after the start", unit="s")
    until_s: float | None = option(None, "when it ends; never when absent", unit="s")

    def check(self) -> Iterator[tuple[str, str]]:
        """Yield each key that does not fit the kind, and why."""
        reach = KINDS[self.kind].reach
        if reach == "variable" and not self.variable:
            yield "variable", f"{self.kind} needs a variable"
        if reach == "item" and self.variable:
            yield "variable", f"{self.kind} disturbs whole messages, and takes no variable"
        if self.variable and not _steps(self.variable):
            yield "variable", "must be a path such as twist.linear.x or cell_voltage[3]"
        if not 0 <= self.at_s < math.inf:
            yield "at_s", "must not be negative"
        if self.until_s is not None and not self.until_s > self.at_s:
            yield "until_s", "must be later than at_s"
        yield from self._wrong_size()

    def _wrong_size(self) -> Iterator[tuple[str, str]]:
        facts = KINDS[self.kind]
        if self.amount is not None and not facts.unit:
            yield "amount", f"{self.kind} has no amount"
        elif self.amount is not None and not facts.low <= self.amount <= facts.high:
            yield "amount", f"must lie from {facts.low:g} to {facts.high:g}"
        elif self.amount is not None and not math.isfinite(self.amount):
            yield "amount", "must be finite"
        if self.kind == "swap" and (not _steps(self.other) or self.other == self.variable):
            yield "other", "swap needs another variable"
        if self.kind != "swap" and self.other:
            yield "other", "is for swap only"
        if self.kind == "unit" and self.conversion not in CONVERSIONS:
            near = did_you_mean(self.conversion, CONVERSIONS)
            yield "conversion", f"must be one of {', '.join(CONVERSIONS)}{near}"
        if self.kind != "unit" and self.conversion:
            yield "conversion", "is for unit only"

    @property
    def size(self) -> float:
        """Return the amount, or the kind's default."""
        default = KINDS[self.kind].default
        return (default or 0.0) if self.amount is None else self.amount

    def __str__(self) -> str:
        """Return the form of the command line."""
        value = "" if self.amount is None else f"{self.amount:g}"
        value = self.other or self.conversion or value
        end = "" if self.until_s is None else f"..{self.until_s:g}s"
        place = f"{self.item}.{self.variable}" if self.variable else self.item
        return f"{self.kind}:{place}{'=' if value else ''}{value}@{self.at_s:g}s{end}"


# -- descriptions


@dataclass(frozen=True)
class _DisturbanceFile:
    disturbances: Sequence[Disturbance] = option(doc="list of disturbances")


def load_disturbances(path: Path) -> Sequence[Disturbance]:
    """Read a YAML file with the list ``disturbances``; ConfigurationError with all its errors."""
    problems: list[Problem] = []
    node = load_yaml(path, problems)
    built = None if node is None else build(_DisturbanceFile, node, problems)
    raise_errors(problems)
    return () if built is None else built.disturbances


def parse_disturbance(text: str) -> Disturbance:
    """Read ``KIND:ITEM.VARIABLE=AMOUNT@20s..40s``, the form of the command line."""
    match = _TEXT.fullmatch(text)
    if match is None:
        raise UsageError(f"cannot read the disturbance {text!r}", _FORM)
    word, value = match["kind"], match["value"] or ""
    kind = next((name for name in KINDS if name == word), None)
    if kind is None:
        raise UsageError(f"unknown disturbance {word!r}{did_you_mean(word, KINDS)}", _FORM)
    try:
        found = Disturbance(
            kind,
            match["item"],
            match["variable"] or "",
            amount=float(value) if value and kind not in ("swap", "unit") else None,
            other=value if kind == "swap" else "",
            conversion=value if kind == "unit" else "",
            at_s=parse_duration_s(match["at"]) if match["at"] else 0.0,
            until_s=parse_duration_s(match["until"]) if match["until"] else None,
        )
    except ValueError as error:
        raise UsageError(f"cannot read the disturbance {text!r}: {error}", _FORM) from error
    for key, what in found.check():
        raise UsageError(f"{text}: {key} {what}", _FORM)
    return found


def address_problems(disturbance: Disturbance) -> Iterator[tuple[str, str]]:
    """Yield the keys that name no topic or variable of the simulated robot, and why."""
    shapes = {spec.name: spec.shape() for spec in TOPICS}
    if disturbance.item not in shapes:
        near = did_you_mean(disturbance.item, shapes)
        yield "item", f"the simulated robot has no topic '{disturbance.item}'{near}"
        return
    known = [path for path, _, _ in leaves(shapes[disturbance.item])]
    for key in ("variable", "other"):
        path = getattr(disturbance, key).partition("[")[0]
        if path and not any(name == path or name.startswith(f"{path}.") for name in known):
            near = did_you_mean(path, known)
            yield key, f"'{disturbance.item}' has no variable '{path}'{near}"


def kinds_as_rows() -> Iterator[tuple[str, str, str, str]]:
    """Yield name, reach, amount and description of each kind, for tables."""
    for name, facts in KINDS.items():
        amount = facts.unit
        if facts.default is not None:
            amount = f"{facts.default:g} {facts.unit}"
        yield name, facts.reach, amount, facts.description


# -- the stream


class Disturber:
    """Disturbs a stream: give it messages in the order in which they come, get them back.

    Messages outside the disturbances pass unchanged, as the same objects, and those that are
    disturbed are copied. Everything follows from the seed and the stream. ``touched`` counts the
    messages that each disturbance has acted on.
    """

    def __init__(
        self, disturbances: Sequence[Disturbance], start_ns: int = 0, seed: int = 1
    ) -> None:
        self.disturbances = tuple(disturbances)
        self._acts: dict[str, list[_Act]] = {}
        self._all = [
            _Act(each, start_ns, random.Random(f"{seed} {number} {each}"))
            for number, each in enumerate(disturbances)
        ]
        for act in self._all:
            self._acts.setdefault(act.of.item, []).append(act)
        self._held: list[tuple[int, int, Message]] = []
        self._count = 0

    @property
    def touched(self) -> list[int]:
        """Return how many messages each disturbance has acted on."""
        return [act.touched for act in self._all]

    def feed(self, messages: Iterable[Message], until_ns: int | None = None) -> Iterator[Message]:
        """Yield what is received, in order of arrival, with the time of arrival.

        Delayed messages are yielded when a later one comes, or before ``until_ns``, if given.
        """
        for message in messages:
            yield from self._due(message[1] + 1)
            acts = self._acts.get(message[0], ())
            received = [message]
            for act in acts:
                received = act.apply(message[1], received)
            for each in received:
                if each[1] <= message[1]:
                    yield each
                else:
                    self._count += 1
                    heapq.heappush(self._held, (each[1], self._count, each))
        if until_ns is not None:
            yield from self._due(until_ns)

    def flush(self) -> Iterator[Message]:
        """Yield the messages that are still on their way."""
        while self._held:
            yield heapq.heappop(self._held)[2]

    def _due(self, before_ns: int) -> Iterator[Message]:
        while self._held and self._held[0][0] < before_ns:
            yield heapq.heappop(self._held)[2]


def disturb(
    messages: Iterable[Message],
    disturbances: Sequence[Disturbance],
    start_ns: int = 0,
    seed: int = 1,
) -> Iterator[Message]:
    """Yield a whole stream as it is received with disturbances, to its last delayed message."""
    disturber = Disturber(disturbances, start_ns, seed)
    yield from disturber.feed(messages)
    yield from disturber.flush()


class _Act:
    """One disturbance at work on the messages of its item."""

    def __init__(self, of: Disturbance, start_ns: int, chance: random.Random) -> None:
        self.of = of
        self.touched = 0
        self._chance = chance
        self._from_ns = start_ns + round(of.at_s * NS)
        end_s = math.inf if of.until_s is None else of.until_s
        self._until_ns = math.inf if end_s == math.inf else start_ns + round(end_s * NS)
        self._last_ns = 0
        self._before: deque[tuple[int, Any]] = deque()
        self._mirror_at: dict[tuple[str | int, ...], float] = {}

    def apply(self, sent_ns: int, received: Sequence[Message]) -> list[Message]:
        """Return what becomes of one message, which earlier acts may have lost or repeated."""
        if not self._from_ns <= sent_ns < self._until_ns:
            for _, _, fields in received:
                self._remember(sent_ns, fields)
            return list(received)
        made = [each for one in received for each in self._disturbed(sent_ns, one)]
        self.touched += [id(each) for each in made] != [id(each) for each in received]
        return made

    def _disturbed(self, sent_ns: int, message: Message) -> list[Message]:
        item, arrives_ns, fields = message
        kind, size = self.of.kind, self.of.size
        if self.of.variable:
            new = self._with_values(sent_ns, fields)
            return [message if new is fields else (item, arrives_ns, new)]
        if kind == "drop":
            return [] if self._chance.random() < size else [message]
        if kind == "repeat":
            return [(item, arrives_ns + _AFTER_NS * n, fields) for n in range(round(size) + 1)]
        share = self._chance.random() if kind == "jitter" else 1.0
        arrives_ns += round(share * size * NS)
        if kind == "jitter":
            arrives_ns = max(arrives_ns, self._last_ns)
            self._last_ns = arrives_ns
        return [(item, arrives_ns, fields)]

    def _with_values(self, sent_ns: int, fields: dict[str, Any]) -> dict[str, Any]:
        steps = _find(fields, self.of.variable)
        if steps is None:
            return fields
        value = _get(fields, steps)
        if self.of.kind == "swap":
            return self._swapped(fields, steps, value)
        if self.of.kind == "freeze":
            if not self._before:
                self._before.append((sent_ns, value))
            return _put(fields, steps, self._before[-1][1])
        if self.of.kind == "delay":
            self._remember(sent_ns, fields)
            return _put(fields, steps, self._before[0][1])
        if self.of.kind == "mirror" and is_list(value):
            return _put(fields, steps, value[::-1])
        return _put(fields, steps, _changed(value, self._change(sent_ns), ()))

    def _swapped(
        self, fields: dict[str, Any], steps: tuple[str | int, ...], value: Any
    ) -> dict[str, Any]:
        others = _find(fields, self.of.other)
        other = None if others is None else _get(fields, others)
        if others is None or _shape(other) != _shape(value):
            return fields
        return _put(_put(fields, steps, other), others, value)

    def _change(self, sent_ns: int) -> Callable[[float, tuple[str | int, ...]], float]:
        """Return the function that changes a number at a place below the variable."""
        kind, size = self.of.kind, self.of.size
        if kind == "scale":
            return lambda value, _: value * size
        if kind in ("offset", "drift"):
            add = size if kind == "offset" else size * (sent_ns - self._from_ns) / NS
            return lambda value, _: value + add
        if kind == "quantise":
            return lambda value, _: round(value / size) * size
        if kind == "unit":
            to = CONVERSIONS[self.of.conversion]
            return lambda value, _: value * to.factor + to.add
        if kind == "sign":
            return lambda value, _: 0 - value
        about = self.of.amount
        if about is not None:
            return lambda value, _: 2 * about - value
        return lambda value, place: 2 * self._mirror_at.setdefault(place, value) - value

    def _remember(self, sent_ns: int, fields: dict[str, Any]) -> None:
        """Keep what freeze and delay need of the values before."""
        if self.of.kind not in ("freeze", "delay") or not self.of.variable:
            return
        steps = _find(fields, self.of.variable)
        if steps is None or sent_ns >= self._until_ns:
            return
        self._before.append((sent_ns, _get(fields, steps)))
        age_ns = round(self.of.size * NS) if self.of.kind == "delay" else 0
        while len(self._before) > 1 and self._before[1][0] <= sent_ns - age_ns:
            self._before.popleft()


def _changed(
    value: Any,
    change: Callable[[float, tuple[str | int, ...]], float],
    place: tuple[str | int, ...],
) -> Any:
    """Change all numbers below a value; each keeps its type, and what is no number stays."""
    if isinstance(value, dict):
        return {key: _changed(each, change, (*place, key)) for key, each in value.items()}
    if is_list(value):
        made = [_changed(each, change, (*place, n)) for n, each in enumerate(value)]
        return np.array(made, value.dtype) if isinstance(value, np.ndarray) else made
    if isinstance(value, bool) or not isinstance(value, numbers.Real) or not math.isfinite(value):
        return value
    try:
        number: Any = value.item() if isinstance(value, np.generic) else value
        new = change(number, place)
        new = round(new) if isinstance(value, numbers.Integral) else new
    except OverflowError:  # as infinity: no number
        return value
    if isinstance(value, numbers.Integral):
        bounds = np.iinfo(value.dtype) if isinstance(value, np.integer) else _INT64
        return _same_type(value, min(max(new, int(bounds.min)), int(bounds.max)))
    return _same_type(value, new) if math.isfinite(new) else value


def _same_type(value: Any, new: float) -> Any:
    return type(value)(new)


def is_list(value: Any) -> bool:
    """Return whether a value is a list of values."""
    return isinstance(value, list | np.ndarray)


def _shape(value: Any) -> Any:
    """Return the types below a value: only values of the same shape can be exchanged."""
    if isinstance(value, dict):
        return {key: _shape(each) for key, each in value.items()}
    return [_shape(each) for each in value] if is_list(value) else type(value)


def _steps(path: str) -> tuple[str | int, ...]:
    """Split ``a.b[2]`` into its steps; empty if it is no path."""
    steps: list[str | int] = []
    for part in path.split("."):
        found = list(_STEP.finditer(part))
        if not found or "".join(m[0] for m in found) != part or found[0][1] is None:
            return ()
        steps += [m[1] if m[1] is not None else int(m[2]) for m in found]
    return tuple(steps)


def _find(fields: Mapping[str, Any], path: str) -> tuple[str | int, ...] | None:
    """Return the steps that lead to a variable, None where the message has none."""
    if path in fields:
        return (path,)
    steps = _steps(path)
    value: Any = fields
    for step in steps:
        known = range(len(value)) if is_list(value) else value if isinstance(value, dict) else ()
        if step not in known:
            return None
        value = value[step]
    return steps or None


def _get(value: Any, steps: Sequence[str | int]) -> Any:
    for step in steps:
        value = value[step]
    return value


def _put(fields: dict[str, Any], steps: Sequence[str | int], new: Any) -> dict[str, Any]:
    """Return a copy with another value at a place; what is beside the way is shared."""
    made = dict(fields)
    inside: Any = made
    for step in steps[:-1]:
        inside[step] = copy.copy(inside[step])
        inside = inside[step]
    inside[steps[-1]] = new
    return made
