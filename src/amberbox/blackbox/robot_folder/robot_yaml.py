"""``robot.yaml``: its keys, their checks, and the options of the retention service.

``triggers:``, ``incidents:`` and ``missions:`` define which windows of the record are kept and what
begins and ends a mission; ``server:`` is the server that the robot reports to.
"""

from __future__ import annotations

import json
import re
import stat
from collections import Counter
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from fnmatch import fnmatchcase
from functools import partial
from pathlib import Path
from typing import Any, Literal
from urllib.parse import urlsplit

import msgspec

from amberbox.core.command import OrderLimit
from amberbox.core.config import Finding, build, raise_errors
from amberbox.core.errors import AmberboxError, Problem, UsageError, did_you_mean
from amberbox.core.expression import Expression, parse
from amberbox.core.expressions.tree import of_monitors
from amberbox.core.mqtt import BrokerLogin, filter_problem, login_problems
from amberbox.core.names import derive_id, is_id
from amberbox.core.options import option
from amberbox.core.units import parse_duration_s
from amberbox.core.yaml_nodes import Node, load_yaml

GB = 1_000_000_000
DAY_S = 86_400.0
MOST_RULES = 100


@dataclass(frozen=True, slots=True)
class Lifetime:
    """After how many seconds parts of the record are deleted, even with room left; None: never."""

    raw_s: float | None = None
    columns_s: float | None = None


@dataclass(frozen=True, slots=True)
class Trigger:
    """A trigger of incidents: a condition that becomes true, an event, or the silence of an item.

    ``when`` is an expression, ``event`` the kind of an event (``*`` matches any text); nothing was
    received of item ``silence`` for ``silence_s``. One of the three is given.
    """

    name: str
    when: str = ""
    event: str = ""
    silence: str = ""
    silence_s: float = 0.0
    before_s: float = 60.0
    after_s: float = 20.0
    hold_off_s: float = 60.0
    reason: str = ""


@dataclass(frozen=True, slots=True)
class MissionRule:
    """Expressions that begin and end a mission of a name.

    ``failed``, ``outcome`` are evaluated at its end, ``parameters`` at its start. After ``max_s``
    it ends automatically.
    """

    name: str
    start: str
    end: str
    failed: str = ""
    outcome: str = ""
    parameters: Mapping[str, str] = field(default_factory=dict)
    max_s: float | None = None


@dataclass(frozen=True, slots=True)
class RetentionOptions:
    """Options of the retention service of one store. Sizes are bytes, times are seconds.

    ``quota`` is None where only the partition sets the limit (``quota_percent`` of it);
    ``incident_share`` is the part of the quota that incidents may hold. ``headroom`` is the size of
    a journal file, ``reserve`` that of the file that holds room free for the last events.
    """

    robot: str = ""
    software_version: str = ""
    config_hash: str = ""
    ring_s: float = 300.0
    quota: int | None = None
    quota_percent: float = 80.0
    min_free: int = GB
    keep_min_s: float = DAY_S
    when_full: Literal["overwrite", "stop"] = "overwrite"
    lifetime: Lifetime = Lifetime()
    headroom: int = 0
    reserve: int = 0
    incident_share: float = 0.5
    incidents_per_hour: int = 10
    triggers: tuple[Trigger, ...] = ()
    missions: tuple[MissionRule, ...] = ()

    def to_json(self) -> str:
        """Return the options as text for the command line of the retention service."""
        return msgspec.json.encode(self).decode()

    @classmethod
    def from_json(cls, text: str) -> RetentionOptions:
        """Read what ``to_json`` wrote."""
        return msgspec.json.decode(text, type=cls)


OWN = ("amberbox_", "probe_")  # prefixes of items that no block of ``black_box.yaml`` names
_KINDS = ("when", "event", "silence")


@dataclass(frozen=True)
class TriggerOptions:
    """What makes an incident: an expression, an event of the box, or the silence of an item."""

    name: str = option(doc="name of the trigger, in events and incidents")
    when: str = option("", "expression: fires when it becomes true")
    event: str = option("", "kind of an event of the box, such as power_battery or source_*")
    silence: str = option("", "ITEM for 5s: fires when nothing is received of it for so long")
    before: float = option(60.0, "how much is kept from before", unit="s")
    after: float = option(20.0, "how much is kept from after", unit="s")
    hold_off: float = option(60.0, "after it has fired it does not fire again for", unit="s")
    reason: str = option("", "what is said of the incident; without, what fired")

    def check(self) -> Iterator[Finding]:
        """Yield each option that is invalid, alone or with others, and why."""
        if not is_id(self.name):
            yield "name", f"'{self.name}' is no id; '{derive_id(self.name)}' would be one"
        given = [kind for kind in _KINDS if getattr(self, kind)]
        if len(given) != 1:
            named = " and ".join(given) if given else "none"
            yield "name", f"one of when, event and silence is needed, {named} is given"
        for key in ("before", "after", "hold_off"):
            if getattr(self, key) < 0:
                yield key, "must not be below 0"
        if self.when and (problem := expression_problem(self.when, with_monitors=True)):
            yield "when", problem.what, problem.hint
        if self.silence and (what := _silence_problem(self.silence)):
            yield "silence", what

    def items(self) -> tuple[str, ...]:
        """Return the items that it reads."""
        if self.silence:
            return (silence_of(self.silence)[0],)
        names = (a.partition(".")[0] for a in self._addresses() if of_monitors(a) is None)
        return tuple(dict.fromkeys(names))

    def of_monitors(self) -> tuple[str, ...]:
        """Return the outputs of monitors and the statuses that it reads."""
        return tuple(a for a in self._addresses() if of_monitors(a) is not None)

    def _addresses(self) -> tuple[str, ...]:
        return parse(self.when).addresses() if self.when else ()


@dataclass(frozen=True)
class IncidentOptions:
    """How much incidents may hold, and how many triggers may make."""

    share: float = option(50.0, "most that incidents may hold of the quota", unit="%")
    per_hour: int = option(10, "most that triggers may make in an hour, one of them half")

    def check(self) -> Iterator[tuple[str, str]]:
        """Yield each option with an invalid value, and why."""
        if not 0 <= self.share <= 100:
            yield "share", "must be from 0 to 100"
        if self.per_hour < 1:
            yield "per_hour", "must be 1 or more"


def expression_problem(text: str, *, with_monitors: bool = False) -> AmberboxError | None:
    """Return why a text is no condition over recorded variables; None if it is one."""
    from amberbox.core.conditions import condition_problem

    return _problem(text, partial(condition_problem, with_monitors=with_monitors))


def _problem(text: str, judge: Callable[[Expression], str]) -> AmberboxError | None:
    try:
        what = judge(parse(text))
    except AmberboxError as error:
        return error
    return UsageError(what) if what else None


def silence_of(text: str) -> tuple[str, float]:
    """Read ``ITEM for 5s``; raises UsageError for anything else."""
    item, _, duration = text.partition(" for ")
    if not item.strip() or not duration.strip():
        raise UsageError(f"'{text}' is no silence", "write: ros_ropod_odom for 5s")
    seconds = parse_duration_s(duration)
    if seconds <= 0:
        raise UsageError(f"'{text}' lasts no time", "write: ros_ropod_odom for 5s")
    return item.strip(), seconds


def _silence_problem(text: str) -> str:
    try:
        silence_of(text)
    except UsageError as error:
        return f"{error.what}; {error.hint}"
    return ""


def trigger_problems(
    root: Node,
    triggers: Sequence[TriggerOptions],
    sources: Sequence[str],
    items: Sequence[str],
    monitors: Collection[str] | None = None,
) -> Iterator[Problem]:
    """Yield a problem for each item that a trigger names and the folder would not record.

    ``root`` is ``robot.yaml``, ``sources`` are the names of the blocks, ``items`` the configured
    items and patterns of items. A source that names no topics records all. ``monitors`` are all
    outputs and statuses, None if they are not known.
    """
    entries = ((root.mapping or {}).get("triggers") or root).items or ()
    for index, (node, trigger) in enumerate(zip(entries, triggers, strict=False)):
        for item in trigger.items():
            what = _unknown(item, sources, items)
            if what:
                yield node.problem(f"triggers[{index}]", what)
        for address in trigger.of_monitors():
            if monitors is not None and address not in monitors:
                what = f"there is no output or status '{address}'{did_you_mean(address, monitors)}"
                when = (node.mapping or {}).get("when", node)
                hint = "outputs are component/mode/output, statuses status(component/mode)"
                yield when.problem(f"triggers[{index}].when", what, hint)
    foreign = (item for t in triggers if t.when for item in t.items())
    if any(not item.startswith(OWN) for item in foreign):
        what = "names of variables are judged when they have been recorded"
        yield root.problem("triggers", what, is_error=False)


def _unknown(item: str, sources: Sequence[str], items: Sequence[str]) -> str:
    top = item.partition("__")[0]
    if item.startswith(OWN) or any(fnmatchcase(top, name) for name in items):
        return ""
    of = [source for source in sources if item.startswith(f"{source}_")]
    listed = [source for source in of if any(i.startswith(f"{source}_") for i in items)]
    if of and len(listed) < len(of):
        return ""
    near = did_you_mean(top, items)
    if of:
        return f"there will be no item '{top}'{near}"
    return f"no source of black_box.yaml gives an item '{top}'{near}"


@dataclass(frozen=True)
class MissionOptions:
    """Configuration of the rule that begins and ends the missions of one kind."""

    name: str = option(doc="kind of mission, such as transport")
    start: str = option(doc="expression: a mission begins when it becomes true")
    end: str = option(doc="expression: the mission ends when it becomes true")
    failed: str = option("", "expression, read at the end: whether it failed")
    outcome: str = option("", "expression, read at the end: what came of it, such as a status")
    parameters: Mapping[str, str] = option({}, "expressions, read at the start, by name")
    max: float | None = option(None, "it ends by itself after this, as timeout", unit="s")

    def check(self) -> Iterator[Finding]:
        """Yield each option that is invalid, alone or with others, and why."""
        from amberbox.core.conditions import address_problem

        if not is_id(self.name):
            yield "name", f"'{self.name}' is no id; '{derive_id(self.name)}' would be one"
        for key in ("start", "end", "failed"):
            text = getattr(self, key)
            if text and (problem := expression_problem(text)):
                yield key, problem.what, problem.hint
        parameters = (("parameters", text) for text in self.parameters.values())
        for key, text in (("outcome", self.outcome), *parameters):
            if text and (problem := _problem(text, address_problem)):
                yield key, problem.what, problem.hint
        if self.max is not None and self.max <= 0:
            yield "max", "must be above 0"

    def rule(self) -> MissionRule:
        """Return the rule of the retention service."""
        return MissionRule(
            self.name, self.start, self.end, self.failed, self.outcome, dict(self.parameters),
            self.max,
        )  # fmt: skip


def read_rules(path: Path) -> tuple[MissionRule, ...]:
    """Read the mission rules of a robot folder or of a YAML file; other keys are ignored.

    Raises UsageError when there is no such file, ConfigurationError for invalid values.
    """
    file = path / "robot.yaml" if path.is_dir() else path
    if not file.is_file():
        raise UsageError(f"there are no rules at {file}", "name a robot.yaml with --rules")
    problems: list[Problem] = []
    root = load_yaml(file, problems)
    raise_errors(problems)
    listed = (root.mapping or {}).get("missions") if root is not None else None
    found: tuple[MissionRule, ...] = ()
    for node in (listed.items or ()) if listed is not None else ():
        built = build(MissionOptions, node, problems, "missions")
        found += () if built is None else (built.rule(),)
    raise_errors(problems)
    return found


# file of the robot's key, beside ``robot.yaml``: no part of the configuration, never uploaded
KEY_FILE = "server.key"
RULES = ("always", "docked", "on_request")
NETWORK = "network "
LOOPBACK = frozenset({"localhost", "127.0.0.1", "::1"})

MeteredSends = Literal["urgent", "statuses"]


@dataclass(frozen=True)
class ServerOptions:
    """The fleet server this robot reports to."""

    url: str = option(doc="address of the fleet server, https://...")
    ca: str = option("", "SHA-256 of the authority that signed its certificate, sha256:...")
    token: str = option("", "the robot's key, where server.key does not hold it", secret=True)
    copy: str = option(
        "always", "when journals are copied: always, docked, on_request, network NAME"
    )
    docked: str = option("", "expression over recorded variables that is true in the dock")
    rate: float = option(0.0, "most that is sent in a second; 0 for as fast as it goes", unit="B")
    metered: Sequence[str] = option((), "networks that cost money, by name or interface: wwan*")
    metered_sends: MeteredSends = option("statuses", "what goes there: urgent, or statuses, too")
    live: bool = option(True, "whether somebody on the server may look at values as they come")

    def check(self) -> Iterator[Finding]:
        """Yield each option with an invalid value, and why."""
        yield from ((key, what) for key, what in self._wrong() if what)
        problem = expression_problem(self.docked) if self.docked else None
        if problem is not None:
            yield "docked", problem.what, problem.hint

    def _wrong(self) -> Iterator[tuple[str, str]]:
        yield "url", url_problem(self.url)
        yield "ca", _ca_problem(self.ca)
        yield "copy", rule_problem(self.copy)
        if self.copy == "docked" and not self.docked:
            yield "docked", "is needed by 'copy: docked': an expression that is true in the dock"
        yield "rate", "must not be below 0" if self.rate < 0 else ""


def url_problem(url: str) -> str:
    """Return what is wrong with a server's address; empty if it is valid."""
    if not url.startswith(("https://", "http://")):
        return "must start with https:// or http://"
    try:
        parts = urlsplit(url)
        _ = parts.port  # access checks it: a port may be no number
    except ValueError:
        return "is no address; write https://fleet.example.org:8443"
    if not parts.hostname or parts.query or parts.fragment:
        return "is no address; write https://fleet.example.org:8443"
    if parts.username or parts.password:
        return "must not hold a key: 'amberbox join' puts it where it belongs"
    if parts.scheme == "http" and parts.hostname not in LOOPBACK:
        return "must start with https://: only a server on this computer is reached without TLS"
    return ""


def rule_problem(rule: str) -> str:
    """Return what is wrong with a rule for copies; empty if it is valid."""
    if rule in RULES or (rule.startswith(NETWORK) and rule[len(NETWORK) :].strip()):
        return ""
    return f"'{rule}' is not one of {', '.join(RULES)}, network NAME"


def _ca_problem(ca: str) -> str:
    digits = ca.lower().removeprefix("sha256:").replace(":", "")
    if not ca or (len(digits) == 64 and not set(digits) - set("0123456789abcdef")):
        return ""
    return "is no fingerprint: sha256: and 64 hex digits, as the server shows them"


def read_key(folder: Path, options: ServerOptions) -> str:
    """Return the robot's key to its server; empty where there is none."""
    try:
        return (folder / KEY_FILE).read_text(encoding="utf-8").strip() or options.token
    except (OSError, UnicodeDecodeError):
        return options.token


def key_notes(node: Node, folder: Path, options: ServerOptions) -> Iterator[Problem]:
    """Yield notes about the robot's key; ``node`` is that of ``server``."""
    keys = node.mapping or {}
    if "token" in keys:
        what = f"the key belongs into {KEY_FILE}: 'amberbox join' with a new line puts it there"
        yield keys["token"].problem("server.token", what, is_error=False)
    if not read_key(folder, options):
        what = "there is no key to it, so nothing is sent: 'amberbox join' with the server's line"
        yield node.problem("server", what, is_error=False)
    file = folder / KEY_FILE
    if file.exists() and stat.S_IMODE(file.stat().st_mode) & 0o077:
        what = f"{KEY_FILE} can be read by others: chmod 600 {KEY_FILE}"
        yield node.problem("server", what, is_error=False)


Format = Literal["paper", "health_status", "diagnostics", "mqtt"]

_LOOPBACK = ("127.", "localhost", "[::1]")
_ROS_URLS = ("ros", "ws", "wss")
_MQTT_URLS = ("mqtt", "mqtts")
_ROS_TOPIC = re.compile(r"(/[A-Za-z][A-Za-z0-9_]*)(/[A-Za-z0-9_]+)*")
_DISCLOSES = "everybody who can reach it reads the robot's name, its components and their states"


@dataclass(frozen=True)
class PublishOptions:
    """One address at which statuses are published: ZeroMQ, a ROS 1 master, a bridge, a broker."""

    url: str = option(
        doc="tcp://127.0.0.1:5581 or ipc://PATH, where it listens for subscribers; ros://HOST:11311"
        " or ros:// for a ROS 1 master; ws://HOST:8765 for a Foxglove bridge; mqtt://HOST:1883 or"
        " mqtts://HOST:8883 for an MQTT broker"
    )
    format: Format = option(
        "paper", "how the messages look; ROS and bridges take diagnostics, brokers mqtt"
    )
    every: float | None = option(
        None, "time between rounds of messages; 0.5 s, for ROS, bridges and brokers 1 s", unit="s"
    )
    topic: str = option(
        "",
        "first frame of each message (none if empty); in ROS, /diagnostics; of a broker what its"
        " topics begin with, amberbox/ROBOT",
    )
    discovery: str = option(
        "", "of a broker: Home Assistant's discovery prefix, homeassistant; no discovery if empty"
    )
    username: str = option("", "user at a broker")
    password: str = option("", "password of that user", secret=True)
    ca_file: str = option(
        "", "certificate of the authority of mqtts://, PEM; the system's if empty"
    )

    def check(self) -> Iterator[tuple[str, str]]:
        """Yield each option with an invalid value, and why; opens nothing."""
        transport, separator, rest = self.url.partition("://")
        host, _, port = rest.rpartition(":")
        if (
            not separator
            or transport not in ("tcp", "ipc", *_ROS_URLS, *_MQTT_URLS)
            or not (rest or self.is_ros or self.is_mqtt)
        ):
            yield "url", f"'{self.url}' is no address; write tcp://127.0.0.1:5581 or ipc://PATH"
        elif transport == "tcp" and not (host and port.isdecimal() and 0 < int(port) < 65536):
            yield "url", f"'{self.url}' has no port; write tcp://127.0.0.1:5581"
        elif transport in _ROS_URLS:
            yield from self._unfit_for_ros(rest)
        if self.is_mqtt or self.format == "mqtt":
            yield from self._unfit_for_mqtt()
        for key in ("discovery", "username", "password", "ca_file"):
            if getattr(self, key) and not self.is_mqtt:
                yield key, "is only for brokers: url: mqtt://HOST"
        if self.every is not None and not 0 < self.every < float("inf"):
            yield "every", "must be above 0"

    def _unfit_for_ros(self, rest: str) -> Iterator[tuple[str, str]]:
        try:
            parts = urlsplit(self.url)
            is_address = bool(parts.hostname) and parts.port != 0
        except ValueError:
            is_address = False
        if rest and not is_address:
            sample = "ros://robot:11311" if self.is_ros else "ws://robot:8765"
            yield "url", f"'{self.url}' is no address; write {sample}"
        if self.format != "diagnostics":
            yield "format", f"ROS has no type for {self.format}; write format: diagnostics"
        if not _ROS_TOPIC.fullmatch(self.ros_topic):
            yield "topic", f"'{self.topic}' is not a name ROS allows for a topic"

    def _unfit_for_mqtt(self) -> Iterator[tuple[str, str]]:
        if self.format != "mqtt" or not self.is_mqtt:
            yield "format", "brokers (url: mqtt://HOST) and format: mqtt go together"
            return
        login = BrokerLogin("", self.username, self.password, self.ca_file)
        yield from login_problems(self.url, login, ("url", "ca_file", "ca_file", "ca_file"))
        for key in ("topic", "discovery"):
            text = getattr(self, key)
            if text and (filter_problem(text) or "+" in text or "#" in text):
                yield key, f"'{text}' is not what topics may begin with"

    def in_folder(self, folder: Path) -> PublishOptions:
        """Return the same with paths seen from the robot folder."""
        if not self.ca_file:
            return self
        return replace(self, ca_file=str(folder / Path(self.ca_file).expanduser()))

    @property
    def is_mqtt(self) -> bool:
        """Return whether it publishes at an MQTT broker."""
        return self.url.startswith(("mqtt://", "mqtts://"))

    @property
    def is_ros(self) -> bool:
        """Return whether it publishes as a ROS 1 node."""
        return self.url.startswith("ros://")

    @property
    def is_bridge(self) -> bool:
        """Return whether it publishes through a Foxglove bridge."""
        return self.url.startswith(("ws://", "wss://"))

    @property
    def ros_topic(self) -> str:
        """Return the topic in ROS."""
        return self.topic or "/diagnostics"

    @property
    def interval_s(self) -> float:
        """Return the time between rounds, seconds."""
        return self.every or (1.0 if self.is_ros or self.is_bridge or self.is_mqtt else 0.5)

    @property
    def is_local(self) -> bool:
        """Return whether only this computer can subscribe; bridge and broker are one known peer."""
        transport, _, rest = self.url.partition("://")
        return (
            transport in ("ipc", "ws", "wss", *_MQTT_URLS) or not rest or rest.startswith(_LOOPBACK)
        )


@dataclass(frozen=True)
class MonitoringOptions:
    """What holds for all monitors of a robot."""

    stale_after: float | Literal["never"] = option(
        5.0, "an input that is silent for longer is stale; mode files may say otherwise", unit="s"
    )
    publish: Sequence[PublishOptions] = option((), "where statuses are published; nowhere without")

    @property
    def stale_s(self) -> float | None:
        """Return the maximum age of an input, seconds; None for any age."""
        return None if self.stale_after == "never" else self.stale_after

    def check(self) -> Iterator[tuple[str, str]]:
        """Yield each option with an invalid value, and why."""
        if self.stale_after != "never" and self.stale_after <= 0:
            yield "stale_after", "must be above 0, or never"


def disclosures(root: Node, options: MonitoringOptions) -> Iterator[Problem]:
    """Yield a note for each publisher open to the network; ``root`` is ``robot.yaml``."""
    entries = _below(_below(root, "monitoring"), "publish")
    for index, (node, entry) in enumerate(zip(entries.items or (), options.publish, strict=False)):
        if not entry.is_local:
            where = f"monitoring.publish[{index}].url"
            what = f"'{entry.url}' is open to the network: {_DISCLOSES}"
            yield _below(node, "url").problem(where, what, is_error=False)


def _below(node: Node, key: str) -> Node:
    return (node.mapping or {}).get(key, node)


@dataclass(frozen=True)
class RecoveryRule:
    """A cause, and the action that is carried out against it without a person."""

    when: str = option(doc="cause: a failure mode component#mode, or a component or component/mode")
    do: str = option(doc="name of the action, of risk `state`")
    at_most: OrderLimit = option(doc="how often, over restarts as well: 3 per 1 h")
    parameters: Mapping[str, Any] = option({}, "its parameters by name", aliases=("with",))
    wait: float = option(30.0, "how long the cause has to last before each attempt", unit="s")
    condition: str = option("", "expression over variables that has to be true", aliases=("if",))

    def check(self) -> Iterator[Finding]:
        """Yield each option with an invalid value, and why."""
        if not 0 <= self.wait <= DAY_S:
            yield "wait", "must be from 0 to 1 d"
        try:
            json.dumps(dict(self.parameters), allow_nan=False)
        except (TypeError, ValueError):
            yield "parameters", "must be numbers, texts, true or false"
        problem = self.condition and expression_problem(self.condition)
        if problem:
            yield "condition", problem.what, problem.hint

    @property
    def parameters_json(self) -> str:
        """Return the parameters as the JSON text of an object."""
        return json.dumps(dict(self.parameters))

    @property
    def key(self) -> str:
        """Return under what its attempts are counted."""
        return f"{self.when} {self.do}"


_DATABASE = re.compile(r"[A-Za-z0-9_-]{1,63}")
_ITEM_PATTERN = re.compile(r"[A-Za-z0-9_*]{1,255}")


@dataclass(frozen=True)
class MongodbOptions:
    """A MongoDB to which items of the record are copied, as the paper's black box stored them."""

    url: str = option(doc="address: mongodb://HOST:27017, further options behind ?")
    database: str = option("logs", "database of the collections")
    items: Sequence[str] = option((), "items to copy, or patterns: ros_*; all of sources if absent")
    layout: Literal["nested", "flat"] = option(
        "nested", "documents like the messages, or with one field per variable"
    )
    user: str = option("", "name to sign in with; without one, nobody signs in")
    password: str = option("", "password of the user", secret=True)

    def check(self) -> Iterator[tuple[str, str]]:
        """Yield each option with an invalid value, and why; opens nothing."""
        yield from ((key, what) for key, what in self._wrong() if what)

    def _wrong(self) -> Iterator[tuple[str, str]]:
        yield "url", mongodb_url_problem(self.url)
        if not _DATABASE.fullmatch(self.database):
            yield "database", f"'{self.database}' is no name: letters, digits, _ and -, at most 63"
        for name in self.items:
            if not _ITEM_PATTERN.fullmatch(name):
                yield "items", f"'{name}' is no item and no pattern; write ros_ropod_odom, or ros_*"
        if self.password and not self.user:
            yield "user", "is needed with a password"

    @property
    def host(self) -> str:
        """Return the address without its options."""
        return urlsplit(self.url).netloc

    def chooses(self, item: str) -> bool:
        """Return whether an item is copied."""
        if not self.items:
            return not item.startswith(OWN)
        return any(fnmatchcase(item, name) for name in self.items)


@dataclass(frozen=True)
class DetectionOptions:
    """Detectors that have learnt from nominal missions, and run beside the watcher."""

    model: str = option(doc="model file of `amberbox learn`, relative to the folder")
    from_server: bool = option(
        False, "whether a command of the server that a person has signed may replace the file"
    )

    def check(self) -> Iterator[tuple[str, str]]:
        """Yield each option with an invalid value, and why; opens nothing."""
        if not self.model or "\0" in self.model:
            yield "model", "is no path"

    def file(self, folder: Path) -> Path:
        """Return the path of the model file of a robot folder."""
        return folder / Path(self.model).expanduser()


def mongodb_url_problem(url: str) -> str:
    """Return what is wrong with the address of a MongoDB; empty if it is valid."""
    try:
        parts = urlsplit(url)
    except ValueError:
        return "is no address; write mongodb://HOST:27017"
    if parts.scheme not in ("mongodb", "mongodb+srv") or not parts.netloc:
        return "must be mongodb://HOST:27017, or mongodb+srv://HOST"
    if "@" in parts.netloc:
        return "must not hold a login: write it under user and password"
    return ""


def mirror_notes(node: Node, options: MongodbOptions) -> Iterator[Problem]:
    """Yield a note if copies leave this computer unencrypted; ``node`` is that of ``mongodb``."""
    hosts = {host.rpartition(":")[0] or host for host in options.host.split(",")}
    is_safe = re.search(r"[?&](tls|ssl)=true", options.url) or options.url.startswith("mongodb+srv")
    if not is_safe and hosts - {*LOOPBACK, "[::1]"}:
        what = f"copies go to {options.host} unencrypted; ?tls=true at the end of url encrypts them"
        yield node.problem("mongodb.url", what, is_error=False)


WhenFull = Literal["overwrite", "stop"]
_SHARE = 8  # a journal file, or the reserve, takes at most this part of the quota
# by default a journal file uses at most this part: several grow, and as much is kept free
_ROTATE_SHARE = 16
# a smaller quota has no room for events, the manifest and the files that are being written
_LEAST_QUOTA = 10_000_000


@dataclass(frozen=True)
class LifetimeOptions:
    """How long the parts of the record are kept at most; without a value until room is needed."""

    raw: float | None = option(None, "journals, as the sources spoke", unit="s")
    columns: float | None = option(None, "their columns", unit="s")

    def check(self) -> Iterator[tuple[str, str]]:
        """Yield each option with an invalid value, and why."""
        for key in ("raw", "columns"):
            if (getattr(self, key) or 1) <= 0:
                yield key, "must be above 0"


@dataclass(frozen=True)
class StoreOptions:
    """Where and how the record is kept."""

    path: str = option("store", "folder of the record, relative to the robot folder")
    quota: int | None = option(None, "most that the record may take", unit="B")
    quota_percent: float = option(80.0, "the same as a share of the partition", unit="%")
    min_free: int = option(1_000_000_000, "room that stays free on the partition", unit="B")
    write_s: float = option(0.1, "a crash of the box loses at most this much", unit="s")
    sync_s: float = option(1.0, "a power cut loses at most this much more", unit="s")
    ring_s: float = option(300.0, "how long items of class ring are kept", unit="s")
    queue: int = option(64_000_000, "memory for messages that wait for the disk", unit="B")
    keep_min: float = option(86_400.0, "the newest data are not deleted for room", unit="s")
    when_full: WhenFull = option("overwrite", "delete the oldest data, or stop recording")
    reserve: int = option(16_000_000, "room set aside for the last events", unit="B")
    lifetime: LifetimeOptions = option(LifetimeOptions(), "when data go though there is room")
    ring_path: str = option("", "folder for the ring, such as one in memory; else in the store")
    rotate_mb: float = option(64.0, "a journal file is closed at this size", unit="MB")
    rotate_s: float = option(600.0, "a journal file is closed at this age", unit="s")

    @property
    def rotate_bytes(self) -> int:
        """Return the size of a journal file, bytes; smaller where the quota is small."""
        size = int(self.rotate_mb * 1e6)
        is_set = self.rotate_mb != StoreOptions.rotate_mb
        return self._share(size, _SHARE if is_set else _ROTATE_SHARE)

    @property
    def reserve_bytes(self) -> int:
        """Return the size of the reserve, bytes; smaller where the quota is small."""
        return self._share(self.reserve)

    def _share(self, size: int, share: int = _SHARE) -> int:
        return size if self.quota is None else min(size, self.quota // share)

    def _too_small(self, quota: int) -> str:
        if quota <= 0:
            return "must be above 0"
        least = f"{_LEAST_QUOTA / 1e6:g} MB"
        return f"must be at least {least}: in less there is no room to record beside what stays"

    def _too_large(self) -> Iterator[tuple[str, str]]:
        """Yield options set to more than their share of the quota; the defaults shrink instead."""
        sizes = {"rotate_mb": int(self.rotate_mb * 1e6), "reserve": self.reserve}
        for key, size in sizes.items():
            is_set = getattr(self, key) != getattr(StoreOptions, key)
            if is_set and self._share(size) < size:
                most = f"{(self.quota or 0) / _SHARE / 1e6:g}"
                unit = "" if key == "rotate_mb" else " MB"
                yield key, f"must be at most {most}{unit}, an eighth of the quota"

    def check(self) -> Iterator[tuple[str, str]]:
        """Yield each option with an invalid value, and why."""
        above_zero = ("write_s", "sync_s", "ring_s", "queue", "rotate_mb", "rotate_s")
        for key in above_zero:
            if getattr(self, key) <= 0:
                yield key, "must be above 0"
        for key in ("min_free", "keep_min", "reserve"):
            if getattr(self, key) < 0:
                yield key, "must not be below 0"
        if self.quota is not None and self.quota < _LEAST_QUOTA:
            yield "quota", self._too_small(self.quota)
        else:
            yield from self._too_large()
        if not 0 < self.quota_percent <= 100:
            yield "quota_percent", "must be above 0 and at most 100"
        if self.sync_s < self.write_s:
            yield "sync_s", f"must not be below write_s ({self.write_s:g} s)"


@dataclass(frozen=True)
class RobotConfig:
    """Everything in ``robot.yaml``."""

    id: str = option("", "name of the robot in addresses and on the server")
    model: str = option("", "make and model")
    software_version: str = option("", "version of the robot's own software")
    store: StoreOptions = option(StoreOptions(), "where and how the record is kept")
    server: ServerOptions | None = option(None, "the fleet server this robot reports to")
    commands: str = option("", "file of who may order what from the server; nobody without")
    recovery: Sequence[RecoveryRule] = option((), "what may be done without a person")
    triggers: Sequence[TriggerOptions] = option((), "what makes an incident")
    missions: Sequence[MissionOptions] = option((), "what begins and ends missions")
    incidents: IncidentOptions = option(IncidentOptions(), "limits of incidents")
    monitoring: MonitoringOptions = option(MonitoringOptions(), "what holds for all monitors")
    mongodb: MongodbOptions | None = option(None, "a database that items are copied to")
    detection: DetectionOptions | None = option(None, "detectors that run beside the watcher")

    def check(self) -> Iterator[tuple[str, str]]:
        """Yield an invalid id, and names that are given twice."""
        for key in ("triggers", "missions"):
            counts = Counter(entry.name for entry in getattr(self, key))
            for name in (name for name, count in counts.items() if count > 1):
                yield key, f"there are several called '{name}'"
        if len(self.recovery) > MOST_RULES:
            yield "recovery", f"are more than {MOST_RULES} rules"
        rules = Counter(rule.key for rule in self.recovery)
        for twice in (key for key, count in rules.items() if count > 1):
            yield "recovery", f"'{twice}' is there twice, and counts once"
        if self.id and not is_id(self.id):
            yield "id", f"'{self.id}' is no id (a-z 0-9 _ . -); '{derive_id(self.id)}' would be one"
