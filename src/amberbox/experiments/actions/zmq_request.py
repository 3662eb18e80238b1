"""A request to a ZeroMQ peer (REQ), JSON in and out; optionally asked until it is done."""

from __future__ import annotations

import json
import re
import time
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import msgspec

from amberbox.core.config import Finding
from amberbox.core.contracts import ActionContext
from amberbox.core.errors import AmberboxError, NotStartedError
from amberbox.core.options import option
from amberbox.experiments.actions import _placeholders

SAMPLE = """\
drive_linear:
  description: Drive straight ahead
  kind: zmq_request
  endpoint: tcp://127.0.0.1:5557
  request: {do: linear, distance_m: "{distance_m}", speed_m_s: "{speed_m_s}"}
  expect: {ok: true}
  poll: {do: state}
  until: {moving: false}
  safe_stop: {do: stop}
  simulated: {ok: true, moving: false}
  parameters:
    distance_m: {unit: m, min: -2, max: 2}
    speed_m_s: {unit: m/s, min: 0.05, max: 0.3, default: 0.2}
  risk: moves
  timeout: 30 s
"""

_ENDPOINT = re.compile(r"tcp://(?:[\w.-]+|\[[0-9A-Fa-f:]+\]):\d{1,5}|ipc://\S+")
_ANSWER_BYTES = 1_000_000
_LOOK_MS = 50  # how often an abort is looked for


@dataclass(frozen=True)
class Config:
    """How the peer is asked."""

    endpoint: str = option(doc="the peer, tcp://HOST:PORT or ipc://PATH")
    request: Any = option(doc='JSON that starts the action; "{name}" is the value of a parameter')
    expect: Mapping[str, Any] = option({}, "values that the answers must have, or it has failed")
    poll: Any = option(None, "JSON that is asked until the answer has the values of `until`")
    until: Mapping[str, Any] = option({}, "values in the answer to `poll` when it is done")
    poll_every: float = option(0.2, "time between two polls", unit="s")
    connect_within: float = option(2.0, "longest wait for a connection", unit="s")
    answer_within: float = option(5.0, "longest wait for one answer", unit="s")
    safe_stop: Any = option(None, "JSON that stops the robot; also when `request` is not answered")
    stop_endpoint: str = option("", "where `safe_stop` is sent, if not to `endpoint`")
    simulated: Any = option(None, "answer of the simulated twin, which sends nothing")
    simulated_for: float = option(1.0, "how long the simulated twin takes", unit="s")

    def check(self) -> Iterator[Finding]:
        """Yield what is wrong with the values."""
        for key in ("endpoint", "stop_endpoint"):
            address = getattr(self, key)
            if (address or key == "endpoint") and not _ENDPOINT.fullmatch(address):
                yield key, f"'{address}' is no address", "such as tcp://127.0.0.1:5557"
        if (self.poll is None) != (not self.until):
            yield "poll" if self.poll is not None else "until", "'poll' and 'until' go together"
        for key in ("poll_every", "connect_within", "answer_within"):
            if not 0 < getattr(self, key) <= 3600:
                yield key, "must be above 0 and at most 3600 s"
        if not 0 <= self.simulated_for <= 3600:
            yield "simulated_for", "must be from 0 to 3600 s"


def problems(config: Config, parameters: Collection[str]) -> Iterator[tuple[str, str]]:
    """Yield placeholders without a parameter, and parameters without an effect."""
    templates = {key: getattr(config, key) for key in ("request", "poll", "safe_stop", "simulated")}
    yield from _placeholders.problems(templates, parameters, "request", "poll")


def run(config: Config, context: ActionContext) -> Mapping[str, Any] | None:
    """Send the request, poll until it is done, and return the last answer."""
    answer = _ask(config, config.endpoint, config.request, context, NotStartedError)
    while answer is not None:
        _check_expected(config.expect, answer)
        if config.poll is None or _has(answer, config.until):
            return answer
        if context.wait(config.poll_every):
            return None
        answer = _ask(config, config.endpoint, config.poll, context, AmberboxError)
    return None


def safe_stop(config: Config, context: ActionContext) -> None:
    """Send the stop on a connection of its own."""
    endpoint = config.stop_endpoint or config.endpoint
    answer = _ask(config, endpoint, config.safe_stop, context, AmberboxError)
    if answer is None:
        raise AmberboxError(f"{endpoint} did not answer the stop")
    _check_expected(config.expect, answer)


def simulated(config: Config, context: ActionContext) -> Mapping[str, Any] | None:
    """Wait as the robot would, and return the declared answer."""
    if context.wait(config.simulated_for):
        return None
    answer = _placeholders.filled(config.simulated, context.parameters)
    return answer if isinstance(answer, Mapping) else {"answer": answer}


def _ask(
    config: Config,
    endpoint: str,
    template: Any,
    context: ActionContext,
    unconnected: type[AmberboxError],
) -> Mapping[str, Any] | None:
    """Return the answer to one request; None if the run must end before there is one.

    A request is only sent once the peer is connected, and never later: a request that waits in a
    queue would move the robot when nobody expects it. Raises ``unconnected`` without a connection.
    """
    import zmq

    request = json.dumps(_placeholders.filled(template, context.parameters), allow_nan=False)
    socket: zmq.Socket[bytes] = zmq.Context.instance().socket(zmq.REQ)
    try:
        socket.setsockopt(zmq.LINGER, 0)
        socket.setsockopt(zmq.IMMEDIATE, 1)
        socket.setsockopt(zmq.MAXMSGSIZE, _ANSWER_BYTES)
        socket.ipv6 = "[" in endpoint
        socket.connect(endpoint)
        if not _wait(socket, zmq.POLLOUT, config.connect_within, context):
            if context.stopped():
                return None
            hint = "is the peer running, and is the address right?"
            raise unconnected(f"nobody listens at {endpoint}", hint)
        socket.send(request.encode(), zmq.NOBLOCK)
        if not _wait(socket, zmq.POLLIN, config.answer_within, context):
            if context.stopped():
                return None
            hint = "does the peer hang, or answer something else first? see answer_within"
            what = f"{endpoint} did not answer within {config.answer_within:g} s"
            raise AmberboxError(what, hint)
        return _decoded(endpoint, socket.recv(zmq.NOBLOCK))
    except zmq.ZMQError as error:
        raise AmberboxError(f"{endpoint}: {error.strerror}") from error
    finally:
        socket.close(linger=0)


def _wait(socket: Any, event: int, within_s: float, context: ActionContext) -> bool:
    """Wait until a socket is ready; return False when time is up or the run must end."""
    end_s = time.monotonic() + within_s
    while not context.stopped():
        left_ms = round((end_s - time.monotonic()) * 1000)
        if socket.poll(max(0, min(left_ms, _LOOK_MS)), event):
            return True
        if left_ms <= 0:
            return False
    return False


def _decoded(endpoint: str, data: bytes) -> Mapping[str, Any]:
    try:
        answer = msgspec.json.decode(data)
    except (msgspec.MsgspecError, UnicodeDecodeError, RecursionError) as error:
        raise AmberboxError(f"the answer of {endpoint} is no JSON: {error}") from None
    return answer if isinstance(answer, dict) else {"answer": answer}


def _check_expected(expected: Mapping[str, Any], answer: Mapping[str, Any]) -> None:
    for key, value in expected.items():
        if key not in answer or answer[key] != value:
            shown = json.dumps(answer, ensure_ascii=False)
            raise AmberboxError(f"the peer answered {shown[:300]}, not {key}: {json.dumps(value)}")


def _has(answer: Mapping[str, Any], values: Mapping[str, Any]) -> bool:
    return all(key in answer and answer[key] == value for key, value in values.items())
