"""A client of ROS 1 action servers (actionlib): one goal, its states, its result.

A server has five topics: it reads ``goal`` and ``cancel``, and publishes ``status``, ``feedback``
and ``result`` (http://wiki.ros.org/actionlib/DetailedDescription).
"""

from __future__ import annotations

import secrets
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from types import TracebackType
from typing import Any, Literal

from amberbox.blackbox.sources.ros1.deadline import Deadline
from amberbox.blackbox.sources.ros1.master import NodeSettings, RosError
from amberbox.blackbox.sources.ros1.message_type import ActionType, MessageType, message_type
from amberbox.blackbox.sources.ros1.node import RosNode, TopicReader, TopicWish
from amberbox.blackbox.sources.ros1.topic_server import OfferedTopic

GoalState = Literal[
    "pending", "active", "preempted", "succeeded", "aborted", "rejected", "preempting",
    "recalling", "recalled", "lost",
]  # fmt: skip
STATES: Sequence[GoalState] = (
    "pending", "active", "preempted", "succeeded", "aborted", "rejected", "preempting",
    "recalling", "recalled", "lost",
)  # fmt: skip
"""The states of a goal by their numbers in actionlib_msgs/GoalStatus."""

ENDED = frozenset({"preempted", "succeeded", "aborted", "rejected", "recalled", "lost"})
_ORDER = {"": 0, "pending": 1, "active": 2, "recalling": 3, "preempting": 4}
_LONGEST_TEXT = 500

CANCEL = "actionlib_msgs/GoalID"
STATUS = "actionlib_msgs/GoalStatusArray"


@dataclass
class GoalTracker:
    """The state of one goal, from what its server publishes; times are of one monotonic clock.

    A goal is lost if its server goes away, is silent, does not take it, or no longer knows it. A
    status that ends a goal counts when the result is there, or does not come in ``result_s``.
    """

    goal_id: str
    sent_s: float
    accept_s: float = 5.0
    silent_s: float = 5.0
    result_s: float = 2.0
    gone_s: float = 0.3
    state: GoalState | Literal[""] = ""
    text: str = ""
    result: Mapping[str, Any] | None = None
    feedback: Mapping[str, Any] | None = None
    _heard_s: float = field(default=0.0, init=False)
    _ending: tuple[GoalState, str, float] | None = field(default=None, init=False)
    _left_s: float | None = field(default=None, init=False)

    @property
    def is_over(self) -> bool:
        """Return whether the goal has reached its last state."""
        return self.state in ENDED

    def status_received(self, statuses: Sequence[Mapping[str, Any]], now_s: float) -> None:
        """Update with the list of goals that the server knows."""
        self._heard_s = now_s
        if self.is_over or self._ending is not None:
            return
        for status in statuses:
            if status["goal_id"]["id"] == self.goal_id:
                self._update(status, now_s)
                return
        if self.state:
            self._lose("the server does not know the goal any more; was it restarted?")

    def _update(self, status: Mapping[str, Any], now_s: float) -> None:
        state = _state(status)
        if state is None:
            return
        if state in ENDED:
            self._ending = (state, _one_line(status["text"]), now_s)
        elif _ORDER[state] >= _ORDER.get(self.state, 0):  # a late message does not turn back time
            self.state, self.text = state, _one_line(status["text"])

    def feedback_received(self, message: Mapping[str, Any]) -> bool:
        """Keep the feedback of this goal; return whether it is for it."""
        is_ours = message["status"]["goal_id"]["id"] == self.goal_id and not self.is_over
        if is_ours:
            self.feedback = message["feedback"]
        return is_ours

    def result_received(self, message: Mapping[str, Any]) -> None:
        """End with the result of this goal; those of others are ignored."""
        status = message["status"]
        if self.is_over or status["goal_id"]["id"] != self.goal_id:
            return
        state = _state(status)
        if state not in ENDED:
            self._lose(f"the server sent a result in the state {state or status['status']}")
            return
        self.state, self.text, self.result = state, _one_line(status["text"]), message["result"]

    def server_left(self, now_s: float) -> None:
        """Begin to give the goal up; a result that was sent before may still arrive."""
        self._left_s = now_s if self._left_s is None else self._left_s

    def advance(self, now_s: float) -> None:
        """Draw the conclusions from what did not come in time."""
        if self.is_over:
            return
        if self._ending is not None:
            state, text, since_s = self._ending
            if now_s - since_s > self.result_s or self._left_s is not None:
                self.state, self.text = state, text
        elif self._left_s is not None and now_s - self._left_s > self.gone_s:
            self._lose("the action server is gone")
        elif not self.state and now_s - self.sent_s > self.accept_s:
            self._lose(f"the action server did not take the goal within {self.accept_s:g} s")
        elif now_s - max(self._heard_s, self.sent_s) > self.silent_s:
            self._lose(f"the action server has been silent for {self.silent_s:g} s")

    def _lose(self, why: str) -> None:
        self.state, self.text = "lost", why


def _state(status: Mapping[str, Any]) -> GoalState | None:
    number = status["status"]
    return STATES[number] if number < len(STATES) else None


def _one_line(text: str) -> str:
    return " ".join(text.split())[:_LONGEST_TEXT]


@dataclass(frozen=True)
class GoalOutcome:
    """How a goal ended."""

    state: GoalState
    text: str
    result: Mapping[str, Any] | None
    feedback: Mapping[str, Any] | None


class ActionClient:
    """A client of one action server; use it in a ``with`` block."""

    def __init__(
        self, name: str, kind: ActionType, settings: NodeSettings, deadline: Deadline
    ) -> None:
        self.name = name
        self._kind = kind
        self._changed = threading.Condition()
        self._tracker: GoalTracker | None = None
        self._server = ""
        self._heard: dict[str, Sequence[Mapping[str, Any]]] = {}
        self._cancel = message_type(CANCEL)
        self._status = message_type(STATUS)
        self._readers: dict[str, TopicReader] = {}
        self._bad = ""
        self.statuses_heard = 0
        self._node = RosNode(settings, deadline)
        self._caller_id = settings.caller_id

    def __enter__(self) -> ActionClient:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._node.close()

    def wait_for_server(self, deadline: Deadline) -> None:
        """Connect all topics to one server; raises RosError with what is missing."""
        for word, sent in (("goal", self._kind.goal), ("cancel", self._cancel)):
            self._node.advertise(OfferedTopic(f"{self.name}/{word}", sent.name, sent), deadline)
        for word, kind, received in (
            ("result", self._kind.result, self._result_received),
            ("feedback", self._kind.feedback, self._feedback_received),
            ("status", self._status, self._status_received),
        ):
            wish = TopicWish(f"{self.name}/{word}", kind.name, received, kind, self._lost)
            self._readers[word] = self._node.subscribe(wish, deadline)
        while not self._found_server():
            deadline.check(self._what_is_missing())
            with self._changed:
                self._changed.wait(0.02)

    def _found_server(self) -> bool:
        candidates = set(self._heard)
        for word in ("goal", "cancel"):
            candidates &= self._node.connected(f"{self.name}/{word}")
        for reader in self._readers.values():
            candidates &= reader.nodes()
        self._server = min(candidates, default="")
        return bool(self._server)

    def _what_is_missing(self) -> str:
        troubles = [self._bad, *(reader.trouble for reader in self._readers.values())]
        missing = [
            word for word in ("goal", "cancel") if not self._node.connected(f"{self.name}/{word}")
        ] + [word for word, reader in self._readers.items() if not reader.nodes()]
        what = f"there is no action server {self.name}"
        if self._heard and missing:
            what = f"the action server {self.name} is not connected on {', '.join(missing)}"
        why = next(filter(None, troubles), "")
        return f"{what}: {why}" if why else what

    def send(self, goal: Mapping[str, Any], silent_s: float, now_ns: int) -> str:
        """Send a goal; return its id. Its stamp is zero: servers then use their own clock.

        Raises UsageError if the goal does not fit its type.
        """
        goal_id = f"{self._caller_id}-{secrets.token_hex(8)}"
        message = {"header": {"stamp": "now"}, "goal_id": {"id": goal_id}, "goal": goal}
        data = self._kind.goal.encode(message, now_ns)
        with self._changed:
            now_s = time.monotonic()
            self._tracker = GoalTracker(goal_id, now_s, silent_s, silent_s)
        self._node.publish(f"{self.name}/goal", data)
        return goal_id

    def wait(
        self,
        deadline: Deadline,
        state_changed: Callable[[str, str], None] = lambda state, text: None,
        feedback_came: Callable[[Mapping[str, Any]], None] = lambda feedback: None,
    ) -> GoalOutcome:
        """Wait for the end of the goal; raises RosStoppedError, and NoAnswerError when time is up.

        The goal goes on after these errors: ``cancel`` it.
        """
        tracker = self._tracker
        if tracker is None:
            raise RosError("no goal was sent")
        told: tuple[str, Any] = ("", None)
        while True:
            with self._changed:
                tracker.advance(time.monotonic())
                state, text, feedback = tracker.state, tracker.text, tracker.feedback
            if state and state != told[0] and state not in ENDED:
                state_changed(state, text)
            if feedback is not None and feedback is not told[1]:
                feedback_came(feedback)
            told = (state, feedback)
            if state != "" and state in ENDED:
                state_changed(state, text)  # after the feedback, which came before
                return GoalOutcome(state, text, tracker.result, tracker.feedback)
            deadline.check(f"the goal of {self.name} is still {state or 'not taken'}")
            with self._changed:
                if (tracker.state, tracker.feedback) == (state, feedback):
                    self._changed.wait(0.02)

    def cancel(self, goal_id: str) -> None:
        """Cancel one goal; an empty id cancels all goals of the server."""
        data = self._cancel.encode({"id": goal_id})
        self._node.publish(f"{self.name}/cancel", data)

    def running_goals(self) -> list[str]:
        """Return the goals of this client's name that the server knows and that have not ended.

        A client that was started again finds the goals of the one before.
        """
        with self._changed:
            statuses = self._heard.get(self._server, ())
        return [
            str(status["goal_id"]["id"])
            for status in statuses
            if status["goal_id"]["id"].startswith(f"{self._caller_id}-")
            and _state(status) not in ENDED
        ]

    def flush(self, deadline: Deadline) -> bool:
        """Wait until the server has been sent everything; return whether it has."""
        return not any(
            self._server in self._node.flush(f"{self.name}/{word}", deadline)
            for word in ("goal", "cancel")
        )

    # Called from the threads of the links.

    def _status_received(self, node: str, kind: MessageType, data: bytes) -> None:
        statuses = self._decoded(node, kind, data).get("status_list")
        if statuses is None:
            return
        with self._changed:
            self._heard[node] = statuses
            self.statuses_heard += node == self._server
            if self._tracker is not None and node == self._server:
                self._tracker.status_received(statuses, time.monotonic())
            self._changed.notify_all()

    def _feedback_received(self, node: str, kind: MessageType, data: bytes) -> None:
        with self._changed:
            tracker = self._tracker if node == self._server else None
        if tracker is None:
            return
        message = self._decoded(node, kind, data)
        with self._changed:
            if message and tracker.feedback_received(message):
                self._changed.notify_all()

    def _result_received(self, node: str, kind: MessageType, data: bytes) -> None:
        with self._changed:
            tracker = self._tracker if node == self._server else None
        if tracker is None:
            return
        message = self._decoded(node, kind, data)
        with self._changed:
            if message:
                tracker.result_received(message)
                self._changed.notify_all()

    def _decoded(self, node: str, kind: MessageType, data: bytes) -> dict[str, Any]:
        """Return a message; nothing, and a note, for one that does not fit its type."""
        try:
            return kind.decode(data)
        except RosError as error:
            self._bad = f"{node}: {error.what}"
            return {}

    def _lost(self, node: str) -> None:
        with self._changed:
            self._heard.pop(node, None)
            if node == self._server and self._tracker is not None:
                self._tracker.server_left(time.monotonic())
            self._changed.notify_all()
