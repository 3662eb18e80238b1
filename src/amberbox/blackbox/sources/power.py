"""The box's own power: kernel power supplies, NUT, the lines and files of a UPS HAT."""

from __future__ import annotations

import dataclasses
import shlex
import socket
import threading
import time
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import fmean
from typing import Literal, Protocol

import msgspec

from amberbox.core.options import option
from amberbox.core.source import Power, Sink, TopicOptions
from amberbox.core.types import Topic

SEVERITY: dict[Power, int] = {"mains": 0, "battery": 1, "low": 2}  # how bad each state is
_LONGEST_BYTES = 4096


class UnreadableError(Exception):
    """A supply whose state cannot be read; the text is one line for a person."""


@dataclass(frozen=True, slots=True)
class SupplyReading:
    """State of one supply; unknown values are None.

    ``percentage`` is 0 to 100, ``voltage`` in V, ``current`` in A with the supply's own sign.
    """

    state: Power
    percentage: float | None = None
    voltage: float | None = None
    current: float | None = None
    minutes_left: float | None = None

    def text(self) -> str:
        """Return the state of the battery as text: ``87 %, 12.1 V, 23 min left``."""
        facts = ((self.percentage, "{:.0f} %"), (self.voltage, "{:.2f} V"))
        shown = [form.format(value) for value, form in facts if value is not None]
        if self.minutes_left is not None and self.state != "mains":
            shown.append(f"{self.minutes_left:.0f} min left")
        return ", ".join(shown)


def combine_readings(readings: Iterable[SupplyReading]) -> SupplyReading:
    """Combine supplies: the worst state, the least percentage and time, the worst one's rest."""
    found = sorted(readings, key=lambda reading: -SEVERITY[reading.state])
    percentages = [r.percentage for r in found if r.percentage is not None]
    minutes = [r.minutes_left for r in found if r.minutes_left is not None]
    voltages = [(r.voltage, r.current) for r in found if r.voltage is not None]
    voltage, current = voltages[0] if voltages else (None, found[0].current)
    return SupplyReading(
        found[0].state, min(percentages, default=None), voltage, current, min(minutes, default=None)
    )


def read_text(path: Path) -> str:
    """Read a small file; raise UnreadableError if it cannot be read."""
    try:
        with path.open("rb") as file:
            return file.read(_LONGEST_BYTES).decode(errors="replace").strip("\0 \t\r\n")
    except OSError as error:
        raise UnreadableError(f"{path}: {error.strerror or error}") from None


def read_number(path: Path, scale: float = 1.0) -> float:
    """Read a number such as 11812000 (with scale 1e-6: 11.812)."""
    return number(read_text(path), str(path)) * scale


def number(text: str, where: str) -> float:
    """Read a finite number; raise UnreadableError for anything else."""
    try:
        value = float(text)
    except ValueError:
        raise UnreadableError(f"{where}: '{text[:20]}' is no number") from None
    if value - value != 0:  # infinities and not-a-number
        raise UnreadableError(f"{where}: '{text[:20]}' is no finite number")
    return value


@dataclass(frozen=True)
class StateFile:
    """A supply read from a file with a word for its state, and files with values of the battery.

    A ``*`` in a path matches the number that the kernel gives a device at each start.
    """

    path: str
    states: Mapping[str, Power]
    percent_path: str = ""
    voltage_path: str = ""
    voltage_scale: float = 1.0

    def read(self) -> SupplyReading:
        """Read the files; raise UnreadableError if one is missing or holds an unknown word."""
        word = read_text(found(self.path))
        state = self.states.get(word.casefold())
        if state is None:
            known = ", ".join(self.states)
            raise UnreadableError(f"{self.path} says '{word[:20]}', which is none of {known}")
        percentage = _number(self.percent_path)
        return SupplyReading(state, percentage, _number(self.voltage_path, self.voltage_scale))

    def close(self) -> None:
        """Nothing is kept open."""


def level_states(active: str, means: Power) -> Mapping[str, Power]:
    """Return the states of 0 and 1 on a line whose active level (high or low) means a state."""
    other: Power = "battery" if means == "mains" else "mains"
    return {"1": means, "0": other} if active == "high" else {"0": means, "1": other}


def found(pattern: str) -> Path:
    """Return the first file that matches a path with ``*``."""
    path = Path(pattern)
    if "*" not in pattern:
        return path
    fits = sorted(Path(path.anchor or ".").glob(str(path.relative_to(path.anchor))))
    if not fits:
        raise UnreadableError(f"nothing fits {pattern}")
    return fits[0]


def _number(pattern: str, scale: float = 1.0) -> float | None:
    return read_number(found(pattern), scale) if pattern else None


PORT = 3493
_PATIENCE_S = 0.7  # for connecting and all answers; a source has to stop within a second
_NUT_LONGEST_BYTES = 1 << 20


class Nut:
    """A connection to upsd that is made when needed and kept."""

    def __init__(self, host: str, port: int, ups: str) -> None:
        self._address = (host, port)
        self._ups = ups
        self._link: socket.socket | None = None
        self._deadline = 0.0

    def read(self) -> SupplyReading:
        """Request all variables of the UPS; raise UnreadableError without an answer."""
        self._deadline = time.monotonic() + _PATIENCE_S
        try:
            if not self._ups:
                lines = self._request("LIST UPS")
                names = [
                    words[1] for words in map(_words, lines) if len(words) > 1 and words[0] == "UPS"
                ]
                if len(names) != 1:
                    has = f"{len(names)} UPS ({', '.join(names)})" if names else "no UPS"
                    raise UnreadableError(f"upsd has {has}; name one with 'ups:'")
                self._ups = names[0]
            return reading(dict(_variables(self._request(f"LIST VAR {self._ups}"))))
        except OSError as error:
            self.close()
            host, port = self._address
            what = error.strerror or str(error) or "no answer"
            raise UnreadableError(f"upsd at {host}:{port}: {what}") from None

    def close(self) -> None:
        """Close the connection."""
        if self._link is not None:
            self._link.close()
            self._link = None

    def _request(self, question: str) -> list[str]:
        """Return the lines between ``BEGIN`` and ``END`` of an answer."""
        if self._link is None:
            self._link = socket.create_connection(self._address, self._left_s())
        self._link.sendall(f"{question}\n".encode())
        end = f"END {question}\n"
        answer = self._receive(self._link, end)
        if answer.startswith("ERR"):
            raise UnreadableError(f"upsd says {answer.strip()} to {question}")
        return answer.splitlines()[1:-1]

    def _receive(self, link: socket.socket, end: str) -> str:
        answer = b""
        while not answer.endswith(end.encode()) and not _is_refusal(answer):
            link.settimeout(self._left_s())
            more = link.recv(65536)
            if not more:
                raise ConnectionResetError("the connection was closed")
            answer += more
            if len(answer) > _NUT_LONGEST_BYTES:
                raise ConnectionAbortedError("an answer without end")
        return answer.decode(errors="replace")

    def _left_s(self) -> float:
        return max(0.001, self._deadline - time.monotonic())


def reading(variables: Mapping[str, str]) -> SupplyReading:
    """Read state and battery from a UPS' variables."""
    return SupplyReading(
        _state(variables.get("ups.status", "")),
        _nut_number(variables, "battery.charge"),
        _nut_number(variables, "battery.voltage"),
        _nut_number(variables, "battery.current"),
        _nut_number(variables, "battery.runtime", 1 / 60),
    )


def _state(status: str) -> Power:
    """Parse a status such as ``OL CHRG``; LB counts on battery only, FSD always."""
    words = set(status.split())
    if "FSD" in words or {"OB", "LB"} <= words:
        return "low"
    if "OB" in words:
        return "battery"
    if words & {"OL", "BYPASS"}:
        return "mains"
    raise UnreadableError(f"the UPS says '{status}', which tells nothing about its power")


def _variables(lines: list[str]) -> Iterator[tuple[str, str]]:
    """Yield names and values of lines such as ``VAR ups battery.charge "100"``."""
    for words in map(_words, lines):
        if len(words) == 4 and words[0] == "VAR":
            yield words[2], words[3]


def _words(line: str) -> list[str]:
    try:
        return shlex.split(line)
    except ValueError:  # an open quotation mark
        return []


def _is_refusal(answer: bytes) -> bool:
    return answer.startswith(b"ERR") and answer.endswith(b"\n")


def _nut_number(variables: Mapping[str, str], name: str, scale: float = 1.0) -> float | None:
    try:
        return number(variables[name], name) * scale
    except (KeyError, UnreadableError):
        return None


PLACE = "/sys/class/power_supply"
_STORES = ("Battery", "UPS")
_FED = ("Charging", "Full", "Not charging")
_MICRO = 1e-6


class Sysfs:
    """Supplies of the kernel: the folder of one, or a folder of several that are combined."""

    def __init__(self, path: Path) -> None:
        self._path = path

    def read(self) -> SupplyReading:
        """Read adapters and batteries; raise UnreadableError if the state is not known."""
        folders = [self._path] if (self._path / "type").exists() else self._supplies()
        stores = [folder for folder in folders if _word(folder / "type") in _STORES]
        adapters = [folder for folder in folders if folder not in stores]
        state = _sysfs_state(adapters, stores, self._path)
        return SupplyReading(state, *_battery(stores))

    def close(self) -> None:
        """Nothing is kept open."""

    def _supplies(self) -> list[Path]:
        """Return the supplies of the box; batteries of mice and keyboards are left out."""
        found = sorted(path.parent for path in self._path.glob("*/type"))
        found = [path for path in found if _word(path / "scope") != "Device"]
        if not found:
            raise UnreadableError(f"{self._path} holds no power supply")
        return found


def _sysfs_state(adapters: Sequence[Path], stores: Sequence[Path], place: Path) -> Power:
    online = [
        value
        for value in (_sysfs_number(path / "online") for path in adapters)
        if value is not None
    ]
    statuses = {_word(path / "status") for path in stores}
    if any(online) or "Charging" in statuses:
        return "mains"
    if not online and statuses.isdisjoint({"Discharging", *_FED}):
        raise UnreadableError(f"{place} does not tell whether there is external power")
    if not online and "Discharging" not in statuses:
        return "mains"
    critical = any(_word(path / "capacity_level") == "Critical" for path in stores)
    return "low" if critical else "battery"


def _battery(stores: Sequence[Path]) -> tuple[float | None, ...]:
    """Return percentage, voltage, current and minutes left; batteries are used one by one."""
    percentages = [value for value in map(_percentage, stores) if value is not None]
    minutes = [value for value in map(_minutes, stores) if value is not None]
    voltages = [_sysfs_number(path / "voltage_now", _MICRO) for path in stores]
    currents = [_sysfs_number(path / "current_now", _MICRO) for path in stores]
    return (
        fmean(percentages) if percentages else None,
        next((value for value in voltages if value is not None), None),
        next((value for value in currents if value is not None), None),
        max(minutes, default=None),
    )


def _percentage(store: Path) -> float | None:
    percent = _sysfs_number(store / "capacity")
    if percent is None:
        percent = _ratio(store, "energy_now", "energy_full")
        percent = _ratio(store, "charge_now", "charge_full") if percent is None else percent
        percent = percent if percent is None else 100 * percent
    if percent is None:
        return None
    return min(max(percent, 0.0), 100.0)  # fuel gauges state up to 102


def _minutes(store: Path) -> float | None:
    seconds = _sysfs_number(store / "time_to_empty_now") or _sysfs_number(
        store / "time_to_empty_avg"
    )
    if seconds is not None:
        return seconds / 60
    if _word(store / "status") != "Discharging":
        return None
    hours = _ratio(store, "energy_now", "power_now")
    hours = _ratio(store, "charge_now", "current_now") if hours is None else hours
    return hours if hours is None else abs(hours) * 60


def _ratio(store: Path, part: str, whole: str) -> float | None:
    above, below = _sysfs_number(store / part), _sysfs_number(store / whole)
    return None if above is None or not below else above / below


def _word(path: Path) -> str:
    try:
        return read_text(path)
    except UnreadableError:  # each driver has other files, and some answer "no data" at times
        return ""


def _sysfs_number(path: Path, scale: float = 1.0) -> float | None:
    try:
        return read_number(path, scale)
    except UnreadableError:
        return None


class SupplyReader(Protocol):
    """Reads the state of one supply."""

    def read(self) -> SupplyReading:
        """Read once, in under a second; raise UnreadableError if the state is not known."""

    def close(self) -> None:
        """Close the open connections."""


@dataclass(frozen=True)
class Supply:
    """One supply of the box."""

    kind: Literal["sysfs", "nut", "gpio", "file"] = option("sysfs", "how it is read")
    name: str = option("", "its name in texts and items; the kind when absent")
    path: str = option("", "sysfs: folder of one supply or of all; gpio, file: the file to read")
    host: str = option("127.0.0.1", "nut: where upsd runs")
    port: int = option(PORT, "nut: its port")
    ups: str = option("", "nut: which UPS; the only one when absent")
    active: Literal["high", "low"] = option("high", "gpio: level of the line when it says so")
    means: Power = option("mains", "gpio: what the active line says")
    mains: Sequence[str] = option(("mains", "online"), "file: words for external power")
    battery: Sequence[str] = option(("battery",), "file: words for the box's own battery")
    low: Sequence[str] = option(("low",), "file: words for what is left of it")
    percent_path: str = option("", "gpio, file: file with the battery's percentage")
    voltage_path: str = option("", "gpio, file: file with the battery's voltage")
    voltage_scale: float = option(1.0, "volts per unit of that file; 0.001 for hwmon")
    low_percent: float = option(10.0, "on battery, this much or less is low", unit="%")
    low_voltage: float | None = option(None, "on battery, this many volts or less are low")

    @property
    def title(self) -> str:
        """Return the name for displays and items."""
        return self.name or self.kind

    def check(self) -> Iterator[tuple[str, str]]:
        """Yield each option with an invalid value, and why; reads nothing."""
        if self.kind in ("gpio", "file") and not self.path:
            yield "path", f"is missing: the file that says how the box is powered ({self.kind})"
        if not 0 < self.port < 65536:
            yield "port", "must be between 1 and 65535"
        if not 0 <= self.low_percent < 100:
            yield "low_percent", "must be 0 or more and below 100"
        if self.low_voltage is not None and self.low_voltage <= 0:
            yield "low_voltage", "must be above 0"
        if len(self.ups.split()) > 1:
            yield "ups", "is one word"
        words = [word.casefold() for word in (*self.mains, *self.battery, *self.low)]
        twice = sorted({word for word in words if words.count(word) > 1})
        if self.kind == "file" and twice:
            yield "mains", f"'{twice[0]}' means two things"

    def in_folder(self, folder: Path) -> Supply:
        """Return the same with paths relative to a folder."""
        paths = (self.path, self.percent_path, self.voltage_path)
        path, percent_path, voltage_path = (str(folder / name) if name else "" for name in paths)
        return dataclasses.replace(
            self, path=path, percent_path=percent_path, voltage_path=voltage_path
        )

    def reader(self) -> SupplyReader:
        """Return the reader of this supply; nothing is opened yet."""
        if self.kind == "sysfs":
            return Sysfs(Path(self.path or PLACE))
        if self.kind == "nut":
            return Nut(self.host, self.port, self.ups)
        states = level_states(self.active, self.means) if self.kind == "gpio" else self._words()
        voltage = (self.voltage_path, self.voltage_scale)
        return StateFile(self.path, states, self.percent_path, *voltage)

    def _words(self) -> dict[str, Power]:
        words: dict[str, Power] = {word.casefold(): "mains" for word in self.mains}
        words |= {word.casefold(): "battery" for word in self.battery}
        return words | {word.casefold(): "low" for word in self.low}

    def judged(self, reading: SupplyReading) -> SupplyReading:
        """Return the reading with state ``low`` if the battery is; never with external power."""
        return dataclasses.replace(reading, state="low") if self._is_low(reading) else reading

    def _is_low(self, reading: SupplyReading) -> bool:
        percentage, voltage = reading.percentage, reading.voltage
        little = percentage is not None and percentage <= self.low_percent
        limit = self.low_voltage
        weak = voltage is not None and limit is not None and voltage <= limit
        return reading.state == "battery" and (little or weak)


@dataclass(frozen=True, slots=True)
class PowerLimits:
    """How long a change must last to count, and after how long on battery it counts as low."""

    for_s: float = 1.0
    low_after_s: float | None = None


@dataclass
class PowerStateFilter:
    """Debounces the power state, on a monotonic clock.

    A run that begins with ``low`` counts as on battery until the state has been better: the run
    before has ended because of it, and a restarted one shall not end at once.
    """

    limits: PowerLimits
    state: Power | None = None
    _candidate: Power | None = None
    _since_s: float = 0.0
    _on_battery_s: float | None = None
    _was_better: bool = False

    def update(self, state: Power, now_s: float) -> bool:
        """Update with the present state; return whether the debounced state has changed.

        The first state counts at once.
        """
        self._was_better = self._was_better or state != "low"
        state = self._after_long(state, now_s) if self._was_better else "battery"
        if state != self._candidate:
            self._candidate, self._since_s = state, now_s
        has_lasted = self.state is None or now_s - self._since_s >= self.limits.for_s
        if state == self.state or not has_lasted:
            return False
        self.state = state
        return True

    def _after_long(self, state: Power, now_s: float) -> Power:
        if state == "mains":
            self._on_battery_s = None
            return state
        if self._on_battery_s is None:
            self._on_battery_s = now_s
        limit = self.limits.low_after_s
        return "low" if limit is not None and now_s - self._on_battery_s >= limit else state


TOPIC = "supply"
_FIRST_BACKOFF_S = 1.0
_MAX_BACKOFF_S = 10.0
_WORDS: dict[Power, str] = {
    "mains": "on external power",
    "battery": "external power is lost",
    "low": "the battery is low",
}


class SupplyMessage(msgspec.Struct, omit_defaults=True):
    """A recorded message; unknown values are left out."""

    state: str
    online: bool
    on_battery: bool
    percentage: float | None = None
    voltage: float | None = None
    current: float | None = None
    minutes_left: float | None = None


@dataclass
class _Watched:
    """One supply and its last reading, which stays valid while it cannot be read."""

    supply: Supply
    reader: SupplyReader
    reading: SupplyReading | None = None
    is_up: bool = False
    not_before_s: float = 0.0
    backoff_s: float = _FIRST_BACKOFF_S
    trouble: str = ""

    @property
    def topic(self) -> str:
        """Return the topic of this supply alone."""
        return f"{TOPIC}/{self.supply.title}"


class SupplyWatch:
    """The supplies of a block; ``poll`` reads them once."""

    def __init__(
        self, supplies: Sequence[Supply], limits: PowerLimits, record_s: float, sink: Sink
    ) -> None:
        self._watched = [_Watched(supply, supply.reader()) for supply in supplies]
        self._judge = PowerStateFilter(limits)
        self._record_s = record_s
        self._sink = sink
        self._recorded_s: float | None = None

    def poll(self, now_s: float) -> None:
        """Read the supplies that are due; report a change of power at once, and record."""
        for watched in self._watched:
            if now_s >= watched.not_before_s:
                self._read(watched, now_s)
        readings = [w.reading for w in self._watched if w.reading is not None]
        if not readings:
            return
        whole = combine_readings(readings)
        changed = self._judge.update(whole.state, now_s)
        if changed and self._judge.state is not None:
            self._sink.power(self._judge.state, self._text(self._judge.state, whole))
        due = self._recorded_s is None or now_s - self._recorded_s >= self._record_s
        if any(watched.is_up for watched in self._watched) and (changed or due):
            self._recorded_s = now_s
            self._record(whole)

    def close(self) -> None:
        """Report all supplies as down and close them."""
        for watched in self._watched:
            self._down(watched, "stopped")
            watched.reader.close()

    def _read(self, watched: _Watched, now_s: float) -> None:
        try:
            reading = watched.supply.judged(watched.reader.read())
        except UnreadableError as error:
            self._note_trouble(watched, str(error), now_s)
            return
        if watched.trouble:
            text = f"{watched.supply.title} can be read again"
            self._sink.event("power_readable", text, supply=watched.supply.title)
        watched.reading, watched.trouble = reading, ""
        watched.backoff_s, watched.not_before_s = _FIRST_BACKOFF_S, now_s
        if not watched.is_up:
            watched.is_up = True
            for topic in self._topics(watched):
                self._sink.link_up(topic, watched.supply.title)

    def _note_trouble(self, watched: _Watched, trouble: str, now_s: float) -> None:
        """Emit an event once per trouble and schedule the next attempt."""
        if trouble != watched.trouble:
            watched.trouble = trouble
            text = f"{watched.supply.title} cannot be read: {trouble}; it is tried again"
            self._sink.event("power_unreadable", text, supply=watched.supply.title)
        self._down(watched, trouble)
        watched.not_before_s = now_s + watched.backoff_s
        watched.backoff_s = min(2 * watched.backoff_s, _MAX_BACKOFF_S)

    def _down(self, watched: _Watched, reason: str) -> None:
        if watched.is_up:
            watched.is_up = False
            for topic in self._topics(watched):
                self._sink.link_down(topic, watched.supply.title, reason)

    def _topics(self, watched: _Watched) -> tuple[str, ...]:
        """Return the topics of a supply: the common one, and its own if there are several."""
        return (TOPIC, watched.topic) if len(self._watched) > 1 else (TOPIC,)

    def _record(self, whole: SupplyReading) -> None:
        state = self._judge.state or whole.state
        self._send(TOPIC, whole, state)
        for watched in self._watched:
            if len(self._watched) > 1 and watched.is_up and watched.reading is not None:
                self._send(watched.topic, watched.reading, watched.reading.state)

    def _send(self, topic: str, reading: SupplyReading, state: Power) -> None:
        values = (reading.percentage, reading.voltage, reading.current, reading.minutes_left)
        message = SupplyMessage(state, state == "mains", state != "mains", *values)
        stream = self._sink.topic(Topic(topic, "json"))
        self._sink.message(stream, msgspec.json.encode(message), self._sink.now_ns())

    def _text(self, state: Power, whole: SupplyReading) -> str:
        """Return one line about a change; several supplies are named."""
        named = [w.supply.title for w in self._watched if w.reading and w.reading.state == state]
        by = f" ({', '.join(named)})" if len(self._watched) > 1 and named else ""
        facts = f": {whole.text()}" if whole.text() else ""
        return f"{_WORDS[state]}{by}{facts}"


SAMPLE = """\
- power:
    supplies:
      - {kind: sysfs}
      - {kind: nut, low_percent: 30}
      - {kind: gpio, path: /sys/class/gpio/gpio6/value, means: battery}
    for_s: 1
    low_after_s: 10 min
"""
PASSIVE = "only reads files, and variables of upsd without logging in; it switches nothing"


@dataclass(frozen=True)
class PowerOptions:
    """The ``power`` block."""

    supplies: Sequence[Supply] = option((Supply(),), "where to read; the worst of them counts")
    poll_s: float = option(0.5, "how often the supplies are read", unit="s")
    record_s: float = option(1.0, "a message at least this often, and at each change", unit="s")
    for_s: float = option(1.0, "a change counts when it has lasted this long", unit="s")
    low_after_s: float | None = option(
        None, "on battery for this long counts as low; never when absent", unit="s"
    )

    def check(self) -> Iterator[tuple[str, str]]:
        """Yield each option with an invalid value, and why; reads nothing."""
        if not 0.05 <= self.poll_s <= 60:
            yield "poll_s", "must be between 0.05 and 60 seconds"
        if not 0 <= self.for_s < float("inf"):
            yield "for_s", "must be 0 or more"
        if not 0 < self.record_s <= 3600:
            yield "record_s", "must be above 0, and an hour at most"
        if self.low_after_s is not None and self.low_after_s <= 0:
            yield "low_after_s", "must be above 0"
        if not self.supplies:
            yield "supplies", "names none; leave it out to use what the kernel knows"
        for name, count in Counter(supply.title for supply in self.supplies).items():
            if count > 1:
                yield "supplies", f"{count} are called '{name}'; give each a 'name:' of its own"

    def in_folder(self, folder: Path) -> PowerOptions:
        """Return the same with paths seen from the robot folder."""
        supplies = tuple(supply.in_folder(folder) for supply in self.supplies)
        return dataclasses.replace(self, supplies=supplies)


Config = PowerOptions


class PowerSource:
    """Polls the supplies of the box; reports at once when it runs on its own battery."""

    lossless = False

    def __init__(self, config: PowerOptions, name: str) -> None:
        self.config = config
        self.name = name

    def topics(self) -> Sequence[TopicOptions]:
        """Return the one topic that always exists: all supplies together."""
        return [TopicOptions(name=TOPIC)]

    def run(self, sink: Sink, stop: threading.Event) -> None:
        """Read until ``stop``; supplies may be missing at first, disappear and come back."""
        config = self.config
        limits = PowerLimits(config.for_s, config.low_after_s)
        watch = SupplyWatch(config.supplies, limits, config.record_s, sink)
        try:
            while not stop.is_set():
                watch.poll(time.monotonic())
                stop.wait(config.poll_s)
        finally:
            watch.close()


Source = PowerSource
