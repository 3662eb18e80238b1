"""Requests to the simulated robot over a real socket, from friends and from others."""

from __future__ import annotations

import json
import queue
import subprocess
import sys
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from amberbox.blackbox.sources.sim import Config, Source
from amberbox.core.errors import AmberboxError, UsageError
from amberbox.sim.__main__ import main
from amberbox.sim.command_socket import CommandSocket
from amberbox.sim.live import LiveRun, publish
from amberbox.sim.requests import MAX_REQUEST_BYTES, RobotRequest, decode_request
from amberbox.sim.robot import Robot
from amberbox.testing.clock import PATIENCE_S
from amberbox.testing.contract import MemorySink
from tests.fuzzing import examples, fuzz

zmq = pytest.importorskip("zmq")
HOSTILE: list[tuple[bytes, str]] = [
    (b"", "no JSON"),
    (b"\xff\xfe\x00", "no JSON"),
    (b"{", "no JSON"),
    (b'{"do": "linear", "distance_m": NaN}', "no JSON"),
    (b"[" * 3000, "no JSON"),
    (b"[]", "a request is an object, not list"),
    (b"null", "a request is an object, not None"),
    (b'"linear"', "a request is an object"),
    (b'{"do": ["linear"]}', "there is no list"),
    (b'{"do": "linear", "distance_m": {"a": 1}}', "must be a number, not dict"),
    (b'{"do": "linear", "distance_m": 1e999}', "no JSON"),
    (b'{"do": "linear", "distance_m": ' + b"9" * 400 + b"}", "from -20 to 20 m"),
    (b'{"do": "linear", "distance": 1}', "did you mean 'distance_m'"),
    (b'{"do": "status", "id": "../../etc"}', "there is no command"),
    (b'{"do": "' + b"x" * 4000 + b'"}', "there is no 'xxx"),
    (b'{"do": "status", "' + b"k" * 4000 + b'": 1}', "unknown key 'kkk"),
    (b" " * (MAX_REQUEST_BYTES + 1), "4097 bytes"),
]


class Served:
    """A robot that is served in a thread, as fast as the machine can, and clients of it."""

    def __init__(self, robot: Robot) -> None:
        self.robot = robot
        self.socket = CommandSocket("tcp://127.0.0.1:*")
        self.context = zmq.Context()
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run)
        self._thread.start()

    def send_multipart(self, msg_parts: list[bytes]) -> None:
        """Take what the robot publishes; nobody listens."""

    def _run(self) -> None:
        plan = LiveRun(20.0)
        publish(self.robot, self, plan, queue.SimpleQueue(), self._stop, self.socket)
        self.socket.close("the simulation has ended")

    def client(self, kind: int = zmq.REQ) -> Any:
        """Return a connected socket."""
        socket = self.context.socket(kind)
        socket.setsockopt(zmq.RCVTIMEO, int(PATIENCE_S * 1000))
        socket.setsockopt(zmq.LINGER, 0)
        socket.connect(self.socket.endpoint)
        return socket

    def ask(self, **request: Any) -> dict[str, Any]:
        """Send a request with a client of its own; return the answer."""
        with self.client() as client:
            client.send_json(request)
            return dict(client.recv_json())

    def end(self) -> None:
        """End the robot's time."""
        self._stop.set()
        self._thread.join()

    def close(self) -> None:
        """Close everything."""
        self.end()
        self.context.destroy(linger=0)


@pytest.fixture
def served() -> Iterator[Served]:
    """Return a robot that stands in ward A, and answers."""
    made = Served(Robot(3, scenario="standing"))
    yield made
    made.close()


def test_a_motion_is_answered_when_it_has_ended(served: Served) -> None:
    answer = served.ask(do="linear", distance_m=0.6, speed_m_s=0.4)
    assert (answer["ok"], answer["do"], answer["state"]) == (True, "linear", "done")
    assert answer["result"]["distance_m"] == pytest.approx(0.6, abs=0.03)
    assert served.ask(do="status")["running"] is None


def test_without_waiting_the_answer_is_an_id_to_ask_for(served: Served) -> None:
    answer = served.ask(do="rotate", angle_deg=30, wait=False)
    assert (answer["ok"], answer["state"]) == (True, "running")
    while (later := served.ask(do="status", id=answer["id"]))["state"] == "running":
        assert later["ok"]
    assert (later["id"], later["do"], later["state"]) == (answer["id"], "rotate", "done")


def test_stop_is_answered_while_another_request_waits(served: Served) -> None:
    with served.client() as driver:
        driver.send_json({"do": "go_to", "area": "elevator"})
        while (now := served.ask(do="status"))["running"] is None or now["standstill"]:
            assert now["ok"]
        second = served.ask(do="dock")
        assert (second["ok"], second["state"]) == (False, "refused")
        assert second["reason"].startswith("go_to (command_0001) runs")
        stopped = served.ask(do="stop")
        assert (stopped["ok"], stopped["stopped"]) == (True, "command_0001")
        first = driver.recv_json()
    assert (first["ok"], first["state"]) == (False, "aborted")
    assert first["reason"] == "stopped by command"
    while not (now := served.ask(do="status"))["standstill"]:
        assert now["control"] == "commands"
    assert now["stopped_after_s"] <= 0.3


def test_a_failure_says_why(served: Served) -> None:
    answer = served.ask(do="undock")
    assert (answer["ok"], answer["state"]) == (False, "failed")
    assert answer["reason"] == "is not in the charging station"


def test_who_waits_is_told_that_the_simulation_ends(served: Served) -> None:
    with served.client() as client:
        client.send_json({"do": "go_to", "area": "elevator"})
        while served.ask(do="status")["running"] is None:
            pass
        served.end()
        answer = client.recv_json()
    assert (answer["ok"], answer["reason"]) == (False, "the simulation has ended")


@pytest.mark.parametrize(("data", "part"), HOSTILE)
def test_hostile_requests_are_answered_and_move_nothing(
    served: Served, data: bytes, part: str
) -> None:
    before = served.robot.truth()["pose"]
    with served.client() as client:
        client.send(data)
        answer = client.recv_json()
        assert (answer["ok"], answer["state"]) == (False, "refused")
        assert part in answer["reason"] and len(answer["reason"]) < 600
        client.send_json({"do": "status"})
        assert client.recv_json()["control"] == "tasks", "and the next one is answered as usual"
    assert served.robot.truth()["pose"] == pytest.approx(before, abs=1e-3)


def test_odd_frames_are_answered_and_huge_ones_cost_the_connection(served: Served) -> None:
    with served.client(zmq.DEALER) as client:
        client.send(b'{"do": "status"}')
        assert json.loads(client.recv())["ok"], "without the empty frame of REQ"
        client.send_multipart([b"", b'{"do": "stop"}', b"more"])
        assert "one frame, not" in json.loads(client.recv_multipart()[-1])["reason"]
        client.send_multipart([b"", b"", b""])
        assert not json.loads(client.recv_multipart()[-1])["ok"]
        client.send_multipart([b"x"] * 1000)
        assert "one frame" in json.loads(client.recv_multipart()[-1])["reason"]
        client.send(b"x" * 10_000_000)
        for _ in range(300):
            client.send(b"junk")
    assert served.ask(do="status")["control"] == "tasks"


def test_a_client_that_goes_away_leaves_the_motion_to_its_end(served: Served) -> None:
    with served.client() as client:
        client.send_json({"do": "linear", "distance_m": 0.5})
        while served.ask(do="status")["running"] is None:
            pass
    while (answer := served.ask(do="status", id="command_0001"))["state"] == "running":
        pass
    assert answer["state"] == "done"


@fuzz
@given(st.binary(max_size=200) | st.text(max_size=100).map(str.encode))
@settings(max_examples=examples(100))
def test_any_bytes_are_a_request_or_an_error(data: bytes) -> None:
    try:
        request = decode_request(data)
    except UsageError as error:
        assert error.what and error.hint
    else:
        assert isinstance(request, RobotRequest)


_VALUES = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=60),
    lambda below: st.lists(below, max_size=3) | st.dictionaries(st.text(max_size=9), below),
    max_leaves=5,
)
_KEYS = st.sampled_from(["do", "distance_m", "speed_m_s", "angle_rad", "area", "id", "wait", "x"])
_DO = st.sampled_from(["linear", "rotate", "go_to", "load", "stop", "status", "resume"])


@fuzz
@given(_DO, st.dictionaries(_KEYS, _VALUES, max_size=4))
@settings(max_examples=examples(100))
def test_any_object_is_answered(do: str, request: dict[str, Any]) -> None:
    robot = Robot(3, scenario="standing")
    try:
        answer = robot.command({"do": do, **request})
    except UsageError as error:
        assert len(str(error)) < 1000
    else:
        assert isinstance(answer["ok"], bool) and json.dumps(answer, allow_nan=False)
    list(robot.step_until(0.2))


def test_an_address_that_is_taken_is_an_error_with_a_hint(
    served: Served, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(AmberboxError, match="cannot bind"):
        CommandSocket(served.socket.endpoint)
    arguments = ["--zmq", "tcp://127.0.0.1:*", "--commands", served.socket.endpoint]
    assert main(arguments) == 1
    assert "for commands" in capsys.readouterr().err


def test_the_program_takes_commands(tmp_path: Path) -> None:
    """A real process: drive, stop, and a clean end."""
    command = [sys.executable, "-m", "amberbox.sim", "--zmq", "tcp://127.0.0.1:*"]
    process = subprocess.Popen(
        [*command, "--commands", "tcp://127.0.0.1:*", "--scenario", "standing", "--speed", "4"],
        stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True,
    )  # fmt: skip
    assert process.stdout is not None
    try:
        process.stdout.readline()
        line = process.stdout.readline()
        assert line.startswith("commands on tcp://127.0.0.1:")
        with zmq.Context() as context, context.socket(zmq.REQ) as client:
            client.setsockopt(zmq.RCVTIMEO, int(PATIENCE_S * 1000))
            client.connect(line.split()[-1])
            client.send_json({"do": "linear", "distance_m": 0.4})
            assert client.recv_json()["state"] == "done"
    finally:
        process.terminate()
        output, _ = process.communicate(timeout=PATIENCE_S)
    assert process.returncode == 0 and output.startswith("published ")


class _Driving(MemorySink):
    """A sink that asks the robot to move with the first message, and ends when it has."""

    def __init__(self, endpoint: str, stop: threading.Event) -> None:
        super().__init__()
        self._endpoint, self._stop = endpoint, stop
        self._client = threading.Thread(target=self._ask)
        self.answer: dict[str, Any] = {}

    def message(self, stream: int, data: bytes, received_ns: int) -> None:
        super().message(stream, data, received_ns)
        if len(self.messages) == 1:
            self._client.start()

    def _ask(self) -> None:
        with zmq.Context() as context, context.socket(zmq.REQ) as client:
            client.setsockopt(zmq.RCVTIMEO, int(PATIENCE_S * 1000))
            client.setsockopt(zmq.LINGER, 0)
            client.connect(self._endpoint)
            client.send_json({"do": "rotate", "angle_rad": 0.5})
            self.answer = client.recv_json()
        self._stop.set()


def test_the_robot_of_the_source_takes_commands_too(tmp_path: Path) -> None:
    endpoint, stop = f"ipc://{tmp_path}/commands", threading.Event()
    sink = _Driving(endpoint, stop)
    config = Config(scenario="standing", speed=10.0, commands=endpoint)
    Source(config, "sim").run(sink, stop)
    assert sink.answer["state"] == "done"
    events = [json.loads(data)["kind"] for data in sink.of("tasks")]
    assert "command_rotate" in events
