"""Requests to a real ZeroMQ peer: answers, silence, a dead peer, an abort while it is silent."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from typing import Any

import pytest

from amberbox.core.errors import AmberboxError, NotStartedError
from amberbox.experiments.actions import zmq_request
from amberbox.experiments.actions.zmq_request import Config
from amberbox.testing.actions import ManualContext
from amberbox.testing.clock import PATIENCE_S
from tests.support.processes import free_port
from tests.support.zmq_robot import ZmqRobot, zmq_robot


@pytest.fixture
def robot() -> Iterator[ZmqRobot]:
    with zmq_robot() as found:
        yield found


def config(robot: ZmqRobot, **more: Any) -> Config:
    request = {"do": "linear", "distance_m": "{distance_m}", "name": "{name}"}
    patient = {"connect_within": PATIENCE_S, "answer_within": PATIENCE_S}
    return Config(robot.endpoint, more.pop("request", request), **patient | more)


def context(**more: Any) -> ManualContext:
    return ManualContext({"distance_m": 1.5, "name": 'x", "do": "dance', **more})


def test_values_stay_values(robot: ZmqRobot) -> None:
    answer = zmq_request.run(config(robot), context())
    assert answer == {"ok": True, "moving": True}
    assert [said for _, said in robot.hears] == [
        {"do": "linear", "distance_m": 1.5, "name": 'x", "do": "dance'}
    ]


def test_values_that_look_like_placeholders_are_not_filled_in(robot: ZmqRobot) -> None:
    zmq_request.run(config(robot), context(name="{distance_m}"))
    assert robot.hears[0][1]["name"] == "{distance_m}"


def test_polls_until_it_is_done(robot: ZmqRobot) -> None:
    options = config(robot, poll={"do": "state"}, until={"moving": False}, poll_every=0.01)
    found: list[Any] = []
    thread = threading.Thread(target=lambda: found.append(zmq_request.run(options, context())))
    thread.start()
    robot.wait_until("state", 3)
    assert not found
    robot.moving = False
    thread.join(PATIENCE_S)
    assert found == [{"ok": True, "moving": False}]
    assert len(robot.heard("linear")) == 1


def test_stops_on_a_connection_of_its_own(robot: ZmqRobot) -> None:
    options = config(robot, safe_stop={"do": "stop"})
    zmq_request.run(options, context())
    zmq_request.safe_stop(options, context())
    assert not robot.moving
    with zmq_robot() as other:
        elsewhere = config(robot, safe_stop={"do": "stop"}, stop_endpoint=other.endpoint)
        zmq_request.safe_stop(elsewhere, context())
        assert len(other.heard("stop")) == 1
    robot.answers["stop"] = b'{"ok": false}'
    with pytest.raises(AmberboxError, match=r'answered {"ok": false}, not ok: true'):
        zmq_request.safe_stop(
            config(robot, safe_stop={"do": "stop"}, expect={"ok": True}), context()
        )


@pytest.mark.parametrize(
    ("answer", "what"),
    [
        (b'{"ok": false, "why": "wall"}', 'answered {"ok": false, "why": "wall"}, not ok: true'),
        (b"{}", "answered {}, not ok: true"),
        (b"yes", "is no JSON"),
        (b"\xff", "is no JSON"),
        (b'{"ok": NaN}', "is no JSON"),
        (b"[" * 100_000, "is no JSON"),
        (b"true", 'answered {"answer": true}, not ok: true'),
    ],
)
def test_answers_that_are_no_success(robot: ZmqRobot, answer: bytes, what: str) -> None:
    robot.answers["linear"] = answer
    with pytest.raises(AmberboxError) as found:
        zmq_request.run(config(robot, expect={"ok": True}), context())
    assert what in found.value.what
    assert not isinstance(found.value, NotStartedError), "the robot was told: it may move"


def test_an_answer_that_is_no_object(robot: ZmqRobot) -> None:
    robot.answers["linear"] = b"[1, 2]"
    assert zmq_request.run(config(robot), context()) == {"answer": [1, 2]}


def test_a_peer_that_hangs(robot: ZmqRobot) -> None:
    robot.answers["linear"] = b""
    start_s = time.monotonic()
    with pytest.raises(AmberboxError, match=r"did not answer within 0\.2 s") as found:
        zmq_request.run(config(robot, answer_within=0.2), context())
    assert time.monotonic() - start_s < PATIENCE_S / 2
    assert "answer_within" in found.value.hint
    assert not isinstance(found.value, NotStartedError)


def test_an_abort_while_the_peer_hangs(robot: ZmqRobot) -> None:
    robot.answers["linear"] = b""
    run, found = context(), list[Any]()
    thread = threading.Thread(target=lambda: found.append(zmq_request.run(config(robot), run)))
    thread.start()
    robot.wait_until("linear")
    stopped_s = time.monotonic()
    run.stop()
    thread.join(PATIENCE_S)
    assert found == [None]
    assert time.monotonic() - stopped_s < PATIENCE_S / 2


def test_a_dead_peer_gets_nothing_when_it_comes_back() -> None:
    """A request that waits in a queue would move the robot when nobody expects it."""
    endpoint = f"tcp://127.0.0.1:{free_port()}"
    options = Config(endpoint, {"do": "linear"}, connect_within=0.2)
    with pytest.raises(NotStartedError, match=f"nobody listens at {endpoint}") as found:
        zmq_request.run(options, context())
    assert found.value.hint == "is the peer running, and is the address right?"
    with zmq_robot(endpoint) as robot:
        zmq_request.run(Config(endpoint, {"do": "state"}), context())
        assert robot.heard("linear") == []


def test_the_twin_sends_nothing(robot: ZmqRobot) -> None:
    options = config(robot, simulated={"at": "{distance_m}"}, simulated_for=0.0)
    assert zmq_request.simulated(options, context()) == {"at": 1.5}
    stopped = context()
    stopped.stop()
    assert zmq_request.simulated(config(robot, simulated=1), stopped) is None
    assert robot.hears == []
