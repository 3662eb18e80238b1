"""Sends a goal to a ROS 1 action server (actionlib) and waits for its end."""

from __future__ import annotations

import json
import math
import time
from collections.abc import Collection, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass
from typing import Any, Literal

from amberbox.blackbox.sources.ros1.action_client import ActionClient
from amberbox.blackbox.sources.ros1.deadline import Deadline, RosStoppedError
from amberbox.blackbox.sources.ros1.master import RosError, global_name
from amberbox.blackbox.sources.ros1.message_type import ActionType, action_type
from amberbox.core.config import Finding
from amberbox.core.contracts import ActionContext
from amberbox.core.errors import AmberboxError, UsageError
from amberbox.core.options import option
from amberbox.experiments.actions import _placeholders
from amberbox.experiments.actions._ros1 import (
    RosPeerOptions,
    check_expected,
    connecting,
    node_settings,
    not_started,
    plain,
    simulate,
    unfit_message,
    unfit_name,
)

SAMPLE = """\
go_to:
  description: Drive to a place on the map
  kind: ros1_action
  server: /move_base
  type: move_base_msgs/MoveBaseAction
  goal:
    target_pose:
      header: {frame_id: map, stamp: now}
      pose: {position: {x: "{x_m}", y: "{y_m}"}, orientation: {w: 1}}
  parameters:
    x_m: {unit: m, min: -50, max: 50}
    y_m: {unit: m, min: -50, max: 50}
  risk: moves
  timeout: 120 s
"""

CANCELLED_S = 0.3  # longest wait for the answer to the cancel of a run that must end
FRESH = 2  # statuses after which a new client knows all goals of the server
_FEEDBACK_S = 1.0


@dataclass(frozen=True, kw_only=True)
class Config(RosPeerOptions):
    """Which server gets which goal."""

    server: str = option(doc="the action server: the topics `goal`, `status`... are below its name")
    type: str = option(doc="its type, as in `move_base_msgs/MoveBaseAction`")
    goal: Mapping[str, Any] = option({}, 'fields of the goal; "{name}" is the value of a parameter')
    definition: str = option("", "text of the type: goal, ---, result, ---, feedback")
    expect: Mapping[str, Any] = option({}, "values that the result must have, or it has failed")
    silent_within: float = option(
        5.0, "the goal is lost when the server does not take it or publishes nothing", unit="s"
    )
    safe_stop: Literal["cancel", "cancel_all", ""] = option(
        "cancel", "`cancel` the goals of this action, or `cancel_all` goals of the server"
    )

    def check(self) -> Iterator[tuple[str, str]]:
        """Yield what is wrong with the values."""
        yield from super().check()
        yield from unfit_name("server", self.server, "topic")
        if not 0.5 <= self.silent_within <= 3600:
            yield "silent_within", "must be from 0.5 to 3600 s"
        try:
            action_type(self.type, self.definition)
        except UsageError as error:
            yield "type", f"{error.what}; {error.hint}" if error.hint else error.what


def problems(config: Config, parameters: Collection[str]) -> Iterator[Finding]:
    """Yield placeholders without a parameter, parameters without an effect, and an unfit goal."""
    templates = {"goal": config.goal, "simulated": config.simulated}
    yield from _placeholders.problems(templates, parameters, "goal")
    kind = action_type(config.type, config.definition).goal
    yield from unfit_message("goal", kind, {"goal": config.goal})


def run(config: Config, context: ActionContext) -> Mapping[str, Any] | None:
    """Send the goal and return its result; cancel it when the run must end or fails."""
    try:
        with not_started():
            client = _client(config, context)
    except RosStoppedError:
        return None
    with client:
        try:
            with not_started():
                client.wait_for_server(connecting(config, context))
                goal = _placeholders.filled(config.goal, context.parameters)
                goal_id = client.send(goal, config.silent_within, time.time_ns())
        except RosStoppedError:
            return None
        try:
            return _follow(config, client, context)
        except RosStoppedError:
            _cancel(client, goal_id, wait_s=CANCELLED_S)
            return None
        except AmberboxError:
            _cancel(client, goal_id, wait_s=0.0)
            raise


def _follow(config: Config, client: ActionClient, context: ActionContext) -> Mapping[str, Any]:
    """Report states and feedback until the goal has ended; return its result."""
    reported_s = -math.inf

    def state_changed(state: str, text: str) -> None:
        context.report(f"{state}: {text}" if text else state)

    def feedback_came(feedback: Mapping[str, Any]) -> None:
        nonlocal reported_s
        if time.monotonic() - reported_s >= _FEEDBACK_S:
            reported_s = time.monotonic()
            context.report(json.dumps(plain(feedback), ensure_ascii=False)[:500])

    outcome = client.wait(Deadline(math.inf, context.stopped), state_changed, feedback_came)
    if outcome.state != "succeeded":
        text = f": {outcome.text}" if outcome.text else ""
        raise RosError(f"the goal of {client.name} is {outcome.state}{text}")
    result: dict[str, Any] = plain(outcome.result or {})
    check_expected(config.expect, result, client.name)
    return {"state": outcome.state, "text": outcome.text, "result": result}


def safe_stop(config: Config, context: ActionContext) -> None:
    """Cancel the goals of this action, also of a run that crashed, and wait until they have ended.

    A client of the same name finds them in the status of the server.
    """
    cancelled: set[str] = set()
    with _client(config, context) as client:
        client.wait_for_server(connecting(config, context))
        if config.safe_stop == "cancel_all":
            client.cancel("")
        while True:
            running = client.running_goals()
            for goal_id in set(running) - cancelled:
                client.cancel(goal_id)
                cancelled.add(goal_id)
            if not running and client.statuses_heard >= FRESH:
                client.flush(Deadline.within(CANCELLED_S))
                return
            if context.wait(0.02):
                client.flush(Deadline.within(CANCELLED_S))
                raise RosError(f"{client.name} was told to cancel, but its goals have not ended")


def simulated(config: Config, context: ActionContext) -> Mapping[str, Any] | None:
    """Send nothing."""
    return simulate(config, context)


def _client(config: Config, context: ActionContext) -> ActionClient:
    kind: ActionType = action_type(config.type, config.definition)
    name = global_name(config.server)
    deadline = connecting(config, context)
    return ActionClient(name, kind, node_settings(config, name), deadline)


def _cancel(client: ActionClient, goal_id: str, wait_s: float) -> None:
    """Cancel a goal, and wait a moment for its end."""
    with suppress(AmberboxError):  # the run has failed or must end in any case
        client.cancel(goal_id)
        client.flush(Deadline.within(CANCELLED_S))
        client.wait(Deadline.within(wait_s))
