"""Names of ROS 2 on the wire: topics, services and types in DDS, keys and tokens in Zenoh."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Literal

MOST_CHARACTERS = 255  # of the name of a topic or type; ROS 2 allows no more

_NAME = re.compile(r"(/[A-Za-z_][A-Za-z0-9_]*)+")
_TYPE = re.compile(r"[A-Za-z]\w*/(msg|srv|action)/[A-Za-z]\w*", re.ASCII)
_DDS_TYPE = re.compile(r"([A-Za-z]\w*)::(msg|srv|action)::dds_::([A-Za-z]\w*)_", re.ASCII)
_ACTION_TOPICS = ("/_action/status", "/_action/feedback")
_SERVICE_EVENT = "/_service_event"

EndpointKind = Literal["topic", "request", "reply"]
_PREFIXES: dict[str, tuple[EndpointKind, str]] = {
    "rt": ("topic", ""),
    "rq": ("request", "Request"),
    "rr": ("reply", "Reply"),
}


def is_topic_name(name: str) -> bool:
    """Return whether ROS 2 allows a full name for a topic: ``/robot1/odom``."""
    return len(name) <= MOST_CHARACTERS and _NAME.fullmatch(name) is not None


def is_type_name(name: str) -> bool:
    """Return whether a name is that of a message type: ``nav_msgs/msg/Odometry``."""
    return len(name) <= MOST_CHARACTERS and _TYPE.fullmatch(name) is not None


def is_action_topic(name: str) -> bool:
    """Return whether a topic is the status or the feedback of an action."""
    return name.endswith(_ACTION_TOPICS)


def is_service_event(name: str) -> bool:
    """Return whether a topic has the requests and responses of a service (REP 2012)."""
    return name.endswith(_SERVICE_EVENT)


def is_hidden(name: str) -> bool:
    """Return whether ROS 2 lists a name only when asked for: a part of it begins with ``_``."""
    return "/_" in name


def dds_type(type_name: str) -> str:
    """Return the name of a type in DDS: ``nav_msgs::msg::dds_::Odometry_``."""
    package, kind, name = type_name.split("/")
    return f"{package}::{kind}::dds_::{name}_"


def type_of_dds(name: str) -> str:
    """Return the name of a type in ROS 2; empty for a type that is none of ROS 2."""
    found = _DDS_TYPE.fullmatch(name) if len(name) <= MOST_CHARACTERS else None
    return "/".join(found.groups()) if found else ""


@dataclass(frozen=True, slots=True)
class DdsEndpoint:
    """What a topic of DDS carries: a topic of ROS 2, or one direction of a service."""

    kind: EndpointKind
    name: str


def dds_topic(name: str) -> str:
    """Return the name of a topic in DDS: ``rt/odom``."""
    return "rt" + name


def endpoint_of_dds(topic: str) -> DdsEndpoint | None:
    """Return what a topic of DDS carries; None for one that is none of ROS 2."""
    prefix, slash, rest = topic.partition("/")
    if prefix not in _PREFIXES:
        return None
    kind, suffix = _PREFIXES[prefix]
    name = slash + rest
    if not name.endswith(suffix) or not is_topic_name(name):
        return None
    return DdsEndpoint(kind, name.removesuffix(suffix))


_TOKENS = "@ros2_lv"
_ENTITIES = ("NN", "MP", "MS", "SS", "SC")  # node, publisher, subscriber, service, client
NO_HASH = "TypeHashNotSupported"
_TRANSIENT_LOCAL = "1"  # in the second part of the QoS; empty there is volatile


def zenoh_key(domain: int, topic: str, type_name: str, type_hash: str) -> str:
    """Return the key of a topic under ``rmw_zenoh``: ``0/odom/nav_msgs::msg::dds_::...``."""
    return f"{domain}{topic}/{dds_type(type_name)}/{type_hash or NO_HASH}"


def zenoh_tokens(domain: int) -> str:
    """Return the key expression of all liveliness tokens of a domain."""
    return f"{_TOKENS}/{domain}/**"


@dataclass(frozen=True, slots=True)
class ZenohEntity:
    """What one liveliness token says: a node, or what a node publishes, reads or serves.

    ``kind`` is NN, MP, MS, SS or SC. ``type_hash`` is empty where the robot gives none.
    """

    kind: str
    node: str
    name: str = ""
    type_name: str = ""
    type_hash: str = ""
    latched: bool = False


def entity_of_token(key: str) -> ZenohEntity | None:
    """Return what a token says; None for one that ``rmw_zenoh`` does not write.

    ``@ros2_lv/<domain>/<session>/<node id>/<id>/<kind>/<enclave>/<namespace>/<node>``, and of all
    but nodes ``/<name>/<type>/<hash>/<QoS>``, each with ``%`` for ``/``.
    """
    parts = key.split("/")
    if len(parts) < 9 or parts[0] != _TOKENS or parts[5] not in _ENTITIES:
        return None
    kind, node = parts[5], _plain(parts[7]).rstrip("/") + "/" + _plain(parts[8])
    if not is_topic_name(node):
        return None
    if kind == "NN":
        return ZenohEntity(kind, node)
    if len(parts) < 13:
        return None
    name, type_name = _plain(parts[9]), type_of_dds(parts[10])
    if not is_topic_name(name) or not type_name:
        return None
    type_hash = "" if parts[11] == NO_HASH else parts[11]
    durability = parts[12].split(":")[1:2]
    return ZenohEntity(kind, node, name, type_name, type_hash, durability == [_TRANSIENT_LOCAL])


def _plain(part: str) -> str:
    return part.replace("%", "/")
