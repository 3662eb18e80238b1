"""The ``ros2`` block: the way to the robot, and what is recorded of it."""

from __future__ import annotations

import os
import platform
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from importlib.util import find_spec
from pathlib import Path
from typing import Any, ClassVar, Literal
from urllib.parse import parse_qsl, urlencode, urlsplit

from amberbox.blackbox.columns.ros2_types import DISTRIBUTIONS
from amberbox.blackbox.sources.ros2_transports import names
from amberbox.core.errors import UsageError, did_you_mean
from amberbox.core.options import option
from amberbox.core.topic_selection import SelectionOptions, TopicPattern

Via = Literal["dds", "zenoh", "bridge"]
# the package of each way, and the extra that installs it
PACKAGES: Mapping[str, tuple[str, str]] = {
    "dds": ("cyclonedds", "ros2-dds"),
    "zenoh": ("zenoh", "ros2-zenoh"),
    "bridge": ("websockets", "ros2-bridge"),
}
BRIDGE_URL = "ws://localhost:8765"
ZENOH_ENDPOINT = "tcp/localhost:7447"
HIGHEST_DOMAIN = 232
DEEPEST = 100_000


@dataclass(frozen=True)
class TopicQos:
    """The quality of service that the box asks for as a subscriber of a topic."""

    reliability: Literal["", "best_effort", "reliable"] = option(
        "", "dds: reliable has lost messages repeated; best_effort when absent, unless latched"
    )
    durability: Literal["", "volatile", "transient_local"] = option(
        "", "transient_local also reads what was sent before; what the publisher offers when absent"
    )
    depth: int | None = option(
        None, "messages kept until the box takes them, and of those sent before"
    )

    def check(self) -> Iterator[tuple[str, str]]:
        """Yield each key with an invalid value, and why."""
        if self.depth is not None and not 1 <= self.depth <= DEEPEST:
            yield "depth", f"must be between 1 and {DEEPEST}"
        if (self.reliability, self.durability) == ("best_effort", "transient_local"):
            yield "durability", "what was sent before only comes with 'reliability: reliable'"


@dataclass(frozen=True, kw_only=True)
class Ros2Options(SelectionOptions):
    """The ``ros2`` block."""

    left_out: ClassVar[Sequence[str]] = ()

    all_topics: bool = option(False, "record every topic there is, hidden ones excepted")
    via: Via = option(doc="way to the robot: dds, zenoh, or bridge (a Foxglove bridge on it)")
    domain: int | None = option(
        None, "domain of the robot, dds and zenoh; ROS_DOMAIN_ID, else 0 when absent"
    )
    url: str = option("", f"bridge: its address, {BRIDGE_URL} when absent; wss:// for TLS")
    authority: str = option("", "bridge: certificate (PEM) of who signed that of a wss:// bridge")
    endpoint: str = option("", f"zenoh: the router, {ZENOH_ENDPOINT} when absent")
    mode: Literal["client", "peer"] = option(
        "client", "zenoh: client of a router, or peer of the nodes themselves"
    )
    scouting: bool = option(False, "zenoh: also look for others by multicast, which sends")
    interface: str = option(
        "", "dds: network interface, by name or address; chosen by the library when absent"
    )
    peers: Sequence[str] = option((), "dds: addresses that are asked besides multicast")
    multicast: bool = option(
        True, "dds: find others by multicast; if not, only 'peers' and this host are asked"
    )
    zenoh_config: str = option("", "zenoh: a configuration file of Zenoh (JSON5), for TLS")
    hosts: Mapping[str, str] = option({}, "addresses of host names that do not resolve here")
    definitions: Sequence[str] = option(
        (), "folders of packages with definitions that the robot does not send"
    )
    distribution: str = option(
        "", "ROS 2 distribution of the robot; its type hashes decide when absent, else humble"
    )
    qos: Mapping[str, TopicQos] = option(
        {}, "dds, zenoh: quality of service by topic or pattern; the first that fits counts"
    )
    parameters: bool = option(True, "record parameters when they change")
    actions: bool = option(True, "record status and feedback of actions that patterns find")
    services: bool = option(True, "record events of services that patterns find")
    max_message_mb: float | None = option(
        None, "longer messages are refused; store.queue when absent", unit="MB"
    )
    dead_after_s: float = option(
        20.0, "bridge: a silent peer is probed and given up after", unit="s"
    )

    @staticmethod
    def is_name(name: str) -> bool:
        """Return whether ROS 2 allows a name for a topic."""
        return names.is_topic_name(name)

    @property
    def seen_as(self) -> str:
        """Return what the robot sees of the box, and what is sent to it."""
        return {
            "dds": "as a participant of the domain, announced by DDS discovery; no node, no topic",
            "zenoh": "as a Zenoh session that asks for liveliness tokens; no node, no token",
            "bridge": "as one more client of the bridge, which subscribes for it; no node",
        }[self.via]

    def chosen_domain(self) -> int:
        """Return the domain of the robot: that of the block, else of the environment, else 0."""
        if self.domain is not None:
            return self.domain
        text = os.environ.get("ROS_DOMAIN_ID", "")
        return int(text) if text.isdecimal() and int(text) <= HIGHEST_DOMAIN else 0

    def check(self) -> Iterator[tuple[str, str]]:
        """Yield each option with an invalid value, and why; opens nothing."""
        yield from super().check()
        if self.domain is not None and not 0 <= self.domain <= HIGHEST_DOMAIN:
            yield "domain", f"must be between 0 and {HIGHEST_DOMAIN}"
        if self.url:
            yield from (("url", what) for what in _wrong_url(self.url))
        if self.endpoint and not _is_endpoint(self.endpoint):
            yield "endpoint", f"'{self.endpoint}' is no endpoint; write {ZENOH_ENDPOINT}"
        if self.distribution and self.distribution not in DISTRIBUTIONS:
            suggestion = did_you_mean(self.distribution, DISTRIBUTIONS)
            known = ", ".join(DISTRIBUTIONS)
            yield "distribution", f"'{self.distribution}' is none of {known}{suggestion}"
        if self.max_message_mb is not None and not 0 < self.max_message_mb <= 4095:
            yield "max_message_mb", "must be above 0 and not above 4095"
        yield from self._wrong_qos()
        if not 4 <= self.dead_after_s <= 86400:
            yield "dead_after_s", "must be between 4 seconds and a day"

    def _wrong_qos(self) -> Iterator[tuple[str, str]]:
        if self.qos and self.via == "bridge":
            yield "qos", "a bridge subscribes for the box, by settings of its own; set it there"
            return
        for name, wanted in self.qos.items():
            yield from (("qos", what) for what in self._wrong_with(name))
            if wanted.reliability and self.via == "zenoh":
                what = "over Zenoh the publisher decides on the reliability; leave it out"
                yield "qos", f"'{name}': {what}"
            if wanted.depth is not None and self.via == "zenoh" and wanted.durability == "volatile":
                yield "qos", f"'{name}': over Zenoh 'depth' is only of what was sent before"

    def wanted_qos(self, topic: str) -> TopicQos:
        """Return what ``qos`` says of a topic: the first name or pattern that fits."""
        found = (
            wanted
            for name, wanted in self.qos.items()
            if TopicPattern(self.full_name(name)).fits(topic)
        )
        return next(found, TopicQos())

    def notes(self) -> Iterator[tuple[str, str]]:
        """Yield what is odd: keys of another way, folders and packages that are not there."""
        yield from super().notes()
        owners = {"url": "bridge", "authority": "bridge"}
        owners |= dict.fromkeys(("endpoint", "scouting", "zenoh_config"), "zenoh")
        for key, owner in owners.items():
            if getattr(self, key) and self.via != owner:
                yield key, f"has no effect with 'via: {self.via}', only with {owner}"
        for folder in self.definitions:
            if not Path(folder).expanduser().is_dir():
                yield "definitions", f"there is no folder {folder} yet"
        missing = missing_package(self.via)
        if missing:
            yield "via", missing

    def in_folder(self, folder: Path) -> Ros2Options:
        """Return the same options with paths as seen from the robot folder."""

        def place(path: str) -> str:
            return str(folder / Path(path).expanduser()) if path else ""

        return replace(
            self,
            definitions=tuple(map(place, self.definitions)),
            authority=place(self.authority),
            zenoh_config=place(self.zenoh_config),
        )


_PLACES = {"bridge": "url", "zenoh": "endpoint"}
_DDS_KEYS = ("interface", "peers", "multicast")


def keys_of_address(address: str) -> dict[str, Any]:
    """Return the keys of a block for ``WAY``, ``WAY:PLACE`` or the URL of a bridge.

    The place is a bridge's URL, a Zenoh router's endpoint, or a DDS domain, with what else that
    needs: ``5?interface=eth1&multicast=false``. Without an address it is a bridge on this computer.
    Raises UsageError for other addresses.
    """
    if address.startswith(("ws://", "wss://")):
        return {"via": "bridge", "url": address}
    way, _, place = (address or "bridge").partition(":")
    try:
        if way == "dds":
            return {"via": way, **_dds_keys(place)}
        key = _PLACES[way]
        return {"via": way, **({key: place} if place else {})}
    except (KeyError, ValueError) as error:
        raise UsageError(
            f"'{address}' is no way to a ROS 2 robot",
            "such as ros2=bridge:ws://HOST:8765, ros2=zenoh:tcp/HOST:7447, or ros2=dds:DOMAIN",
        ) from error


def address_of(options: Ros2Options) -> str:
    """Return the address of a robot that ``keys_of_address`` reads; empty if that is not enough."""
    is_more = options.authority or options.zenoh_config or options.hosts or options.scouting
    if is_more or options.mode != "client":
        return ""
    if options.via == "bridge":
        return options.url or BRIDGE_URL
    if options.via == "zenoh":
        is_usual = options.chosen_domain() == replace(options, domain=None).chosen_domain()
        return f"zenoh:{options.endpoint or ZENOH_ENDPOINT}" if is_usual else ""
    keys = [("interface", options.interface)] if options.interface else []
    keys += [("peers", peer) for peer in options.peers]
    keys += [] if options.multicast else [("multicast", "false")]
    more = f"?{urlencode(keys)}" if keys else ""
    return f"dds:{options.chosen_domain()}{more}"


def _dds_keys(place: str) -> dict[str, Any]:
    domain, _, more = place.partition("?")
    if domain and not domain.isdecimal():
        raise ValueError(f"{domain} is no number of a domain")
    keys: dict[str, Any] = {"domain": int(domain)} if domain else {}
    for key, value in parse_qsl(more, strict_parsing=True) if more else ():
        if key == "multicast" and value in ("true", "false"):
            keys[key] = value == "true"
        elif key == "peers":
            keys[key] = [*keys.get(key, []), value]
        elif key == "interface":
            keys[key] = value
        else:
            raise ValueError(f"{key}={value} is none of {', '.join(_DDS_KEYS)}")
    return keys


def missing_package(via: str) -> str:
    """Return what to install for a way to the robot; empty if it is there. Imports nothing."""
    package, extra = PACKAGES[via]
    if find_spec(package) is not None:
        return ""
    if via == "dds" and platform.machine() != "x86_64":
        machine = platform.machine()
        return (
            f"there is no package cyclonedds for {machine}; use 'via: zenoh' or 'via: bridge', "
            "or build it from its sources"
        )
    return f"the package {package} is not installed here: pip install 'amberbox[{extra}]'"


def _wrong_url(url: str) -> Iterator[str]:
    try:
        parts = urlsplit(url)
        is_wrong = parts.scheme not in ("ws", "wss") or not parts.hostname
        parts.port  # noqa: B018  # raises ValueError for one that is none
    except ValueError:
        is_wrong = True
    if is_wrong:
        yield f"'{url}' is no address of a bridge; write {BRIDGE_URL}"


def _is_endpoint(text: str) -> bool:
    protocol, slash, address = text.partition("/")
    host, _, port = address.split("?")[0].split("#")[0].rpartition(":")
    is_port = port.isdecimal() and 0 < int(port) < 65536
    return (
        bool(slash) and protocol in ("tcp", "tls", "quic", "ws", "udp") and bool(host) and is_port
    )
