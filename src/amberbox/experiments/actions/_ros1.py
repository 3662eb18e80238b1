"""What the three kinds of ROS 1 actions share: the options of a node, and its time limits."""

from __future__ import annotations

import math
import os
import re
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

from amberbox.blackbox.sources.ros1.deadline import Deadline, RosStoppedError
from amberbox.blackbox.sources.ros1.master import (
    NodeSettings,
    chosen_master,
    global_name,
    is_global_name,
    master_uri,
)
from amberbox.blackbox.sources.ros1.message_type import UNGIVEN, MessageType
from amberbox.core.contracts import ActionContext
from amberbox.core.errors import AmberboxError, NotStartedError, UsageError
from amberbox.core.options import option
from amberbox.experiments.actions import _placeholders

LONGEST_NAME = 200
_PLACEHOLDER = re.compile(r"\{[A-Za-z_]\w*\}")
_NOT_IN_NAMES = re.compile(r"[^A-Za-z0-9_]+")


@dataclass(frozen=True, kw_only=True)
class RosPeerOptions:
    """How the master and the nodes of a robot are reached."""

    ros_master_uri: str = option("", "the master; ROS_MASTER_URI, else localhost when absent")
    hosts: Mapping[str, str] = option({}, "addresses of host names that do not resolve here")
    advertise: str = option("", "own address for other nodes; ROS_HOSTNAME, ROS_IP when absent")
    caller_id: str = option("", "name as a ROS node; made of the topic or service when absent")
    connect_within: float = option(5.0, "longest wait for the peers to be connected", unit="s")
    simulated: Any = option(None, "result of the simulated twin, which sends nothing")
    simulated_for: float = option(1.0, "how long the simulated twin takes", unit="s")

    def check(self) -> Iterator[tuple[str, str]]:
        """Yield what is wrong with the values."""
        if self.ros_master_uri:
            try:
                master_uri(self.ros_master_uri)
            except ValueError as error:
                yield "ros_master_uri", f"{error}; write http://HOST:11311"
        if self.caller_id:
            yield from unfit_name("caller_id", self.caller_id, "node")
        if not 0 < self.connect_within <= 3600:
            yield "connect_within", "must be above 0 and at most 3600 s"
        if not 0 <= self.simulated_for <= 3600:
            yield "simulated_for", "must be from 0 to 3600 s"


def unfit_name(key: str, name: str, what: str) -> Iterator[tuple[str, str]]:
    """Yield why a name cannot be that of a topic, service or node."""
    if not is_global_name(global_name(name)) or len(name) > LONGEST_NAME:
        yield key, f"'{name[:LONGEST_NAME]}' is not a name ROS allows for a {what}"


def node_settings(config: RosPeerOptions, name: str) -> NodeSettings:
    """Return the settings of the node that acts on a topic or service.

    Its name is always the same for one action: a run that crashed is replaced at the master by
    the next one, or by its own safe stop.
    """
    own = f"/amberbox_act_{_NOT_IN_NAMES.sub('_', global_name(name)[1:])}"
    return NodeSettings(
        master_uri=chosen_master(config.ros_master_uri, os.environ),
        caller_id=global_name(config.caller_id) if config.caller_id else own,
        hosts=config.hosts,
        advertise=config.advertise,
        dead_after_s=10.0,
        timeout_s=min(3.0, config.connect_within),
    )


def connecting(config: RosPeerOptions, context: ActionContext) -> Deadline:
    """Return the deadline of connecting, which ends early when the run must end."""
    return Deadline.within(config.connect_within, context.stopped)


def without_values(template: Any) -> Any:
    """Return a message with its placeholders as values that are not known yet."""
    if isinstance(template, Mapping):
        return {key: without_values(value) for key, value in template.items()}
    if isinstance(template, list | tuple):
        return [without_values(value) for value in template]
    return UNGIVEN if isinstance(template, str) and _PLACEHOLDER.fullmatch(template) else template


def unfit_message(
    key: str, kind: MessageType | None, template: Mapping[str, Any]
) -> Iterator[tuple[str, str]]:
    """Yield why a message does not fit its type; nothing if the type is not known yet."""
    try:
        if kind is not None:
            kind.encode(without_values(template))
    except UsageError as error:
        yield key, error.what


@contextmanager
def not_started() -> Iterator[None]:
    """Turn errors into NotStartedError: the robot has not been told anything."""
    try:
        yield
    except (NotStartedError, RosStoppedError):
        raise
    except AmberboxError as error:
        raise NotStartedError(error.what, error.hint) from error


def plain(value: Any) -> Any:
    """Return a value of a message as JSON has it: numbers that are not finite become texts."""
    if isinstance(value, Mapping):
        return {str(key): plain(each) for key, each in value.items()}
    if isinstance(value, list | tuple):
        return [plain(each) for each in value]
    if isinstance(value, float) and not math.isfinite(value):
        return str(value)
    return value


def check_expected(expected: Mapping[str, Any], answer: Mapping[str, Any], who: str) -> None:
    """Raise AmberboxError unless an answer has the values that are expected."""
    for key, value in expected.items():
        if key not in answer or answer[key] != value:
            shown = str(plain(answer))[:300]
            raise AmberboxError(f"{who} answered {shown}, not {key}: {value}")


def simulate(config: RosPeerOptions, context: ActionContext) -> Mapping[str, Any] | None:
    """Wait as the robot would, and return the declared result."""
    if context.wait(config.simulated_for):
        return None
    answer = _placeholders.filled(config.simulated, context.parameters)
    return answer if isinstance(answer, Mapping) else {"answer": answer}
