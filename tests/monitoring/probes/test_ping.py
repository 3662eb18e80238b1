"""Hosts that answer, refuse or are silent; the frames of ICMP; what the program prints."""

from __future__ import annotations

import errno
import socket
import struct
import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import pytest

from amberbox.core.errors import AmberboxError, UsageError
from amberbox.monitoring.probes.ping import by_program, echo_s, measure, repeated, split
from amberbox.testing.clock import PATIENCE_S
from tests.support.processes import free_port

IPUTILS = """\
PING 192.168.1.7 (192.168.1.7) 56(84) bytes of data.
64 bytes from 192.168.1.7: icmp_seq=1 ttl=64 time=0.551 ms
64 bytes from 192.168.1.7: icmp_seq=3 ttl=64 time=0.449 ms

--- 192.168.1.7 ping statistics ---
3 packets transmitted, 2 received, 33.3333% packet loss, time 403ms
rtt min/avg/max/mdev = 0.449/0.500/0.551/0.051 ms
"""
BUSYBOX = """\
3 packets transmitted, 3 packets received, 0% packet loss
round-trip min/avg/max = 0.080/0.095/0.121 ms
"""
SILENT = """\
From 192.168.1.2 icmp_seq=1 Destination Host Unreachable

--- 192.168.1.9 ping statistics ---
3 packets transmitted, 0 received, +3 errors, 100% packet loss, time 411ms
"""


@pytest.mark.parametrize(
    ("subject", "host", "port"),
    [
        ("robot", "robot", None),
        ("robot.local:22", "robot.local", 22),
        ("192.168.1.7", "192.168.1.7", None),
        ("fe80::1%eth0", "fe80::1%eth0", None),
        ("::1", "::1", None),
        ("[fe80::1]:22", "fe80::1", 22),
        ("[fe80::1]", "fe80::1", None),
    ],
)
def test_host_and_port_are_told_apart(subject: str, host: str, port: int | None) -> None:
    assert split(subject) == (host, port)


@pytest.mark.parametrize("subject", ["", "-c9", "robot:ssh", "a b", "robot:22:1", "[::1", "a/b"])
def test_what_is_no_host_is_refused(subject: str) -> None:
    with pytest.raises(UsageError, match="no host"):
        split(subject)


def test_a_port_that_is_open_and_one_that_is_not() -> None:
    with socket.create_server(("127.0.0.1", 0)) as listening:
        found = measure(f"127.0.0.1:{listening.getsockname()[1]}")
    assert (found["ok"], found["loss_percent"], found["error"]) == (True, 0.0, "")
    assert 0 < found["latency_ms"] < 1000
    assert measure(f"127.0.0.1:{free_port()}") == {
        "ok": False,
        "error": "Connection refused",
        "latency_ms": None,
        "loss_percent": 100.0,
    }


def test_a_name_without_an_address_is_unknown() -> None:
    with pytest.raises(socket.gaierror):
        measure("no-such-host.invalid:22")


def test_this_computer_answers_itself_or_says_why_it_may_not_ask() -> None:
    try:
        found = measure("127.0.0.1")
    except AmberboxError as error:
        assert "no program ping" in error.what
    else:
        assert (found["ok"], found["loss_percent"]) == (True, 0.0)


def answers(*given: float | OSError) -> Callable[[int], float]:
    def ask(number: int) -> float:
        answer = given[number]
        if isinstance(answer, OSError):
            raise answer
        return answer

    return ask


def test_the_mean_is_of_the_answers_and_losses_are_counted() -> None:
    found = repeated(answers(0.010, TimeoutError(), 0.030), 0)
    assert found["ok"] is True
    assert found["latency_ms"] == pytest.approx(20)
    assert found["loss_percent"] == pytest.approx(100 / 3)


@pytest.mark.parametrize(
    ("error", "text"),
    [
        (TimeoutError(), "no answer"),
        (OSError(errno.ENETUNREACH, "Network is unreachable"), "Network is unreachable"),
        (OSError(errno.EHOSTUNREACH, "No route to host"), "No route to host"),
    ],
)
def test_a_host_out_of_reach_is_not_ok(error: OSError, text: str) -> None:
    found = repeated(answers(error, error, error), 0)
    assert (found["ok"], found["error"], found["loss_percent"]) == (False, text, 100.0)


def test_an_error_of_this_computer_says_nothing_of_the_host() -> None:
    with pytest.raises(OSError, match="too many files"):
        repeated(answers(OSError(errno.EMFILE, "too many files")))


@contextmanager
def echo_server(answer: Callable[[bytes], Sequence[bytes]]) -> Iterator[tuple[object, ...]]:
    """Answer requests over UDP, which carries the same frames without privileges."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as server:
        server.bind(("127.0.0.1", 0))

        def serve() -> None:
            request, peer = server.recvfrom(1024)
            for reply in answer(request):
                server.sendto(reply, peer)

        thread = threading.Thread(target=serve, daemon=True)
        thread.start()
        yield server.getsockname()
        thread.join(PATIENCE_S)


@pytest.mark.parametrize(
    ("family", "request_type", "reply_type"), [(socket.AF_INET, 8, 0), (socket.AF_INET6, 128, 129)]
)
def test_only_the_answer_to_this_request_counts(
    family: int, request_type: int, reply_type: int
) -> None:
    seen: list[bytes] = []

    def answer(request: bytes) -> Sequence[bytes]:
        seen.append(request)
        identity = request[4:6]
        late = bytes([reply_type, 0, 0, 0]) + identity + struct.pack("!H", 1)
        right = bytes([reply_type, 0, 0, 0]) + identity + struct.pack("!H", 2) + request[8:]
        return [late, bytes([3, 1]), right]

    with echo_server(answer) as address, socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as echo:
        assert 0 < echo_s(echo, family, address, 2) < 1
    assert seen == [bytes([request_type, 0, 0, 0, 0, 0, 0, 2]) + b"amberbox"]


def test_without_an_answer_it_waits_no_longer_than_a_second() -> None:
    wrong = bytes([0, 0, 0, 0, 0, 0, 0, 9])
    with (
        echo_server(lambda request: [wrong]) as address,
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as echo,
        pytest.raises(TimeoutError),
    ):
        echo_s(echo, socket.AF_INET, address, 2)


def program(folder: Path, printed: str, status: int, said: str = "") -> Sequence[str]:
    path = folder / "ping.py"
    path.write_text(
        f"import sys\nassert sys.argv[1:] == '-n -c 3 -i 0.2 -W 1 192.168.1.7'.split()\n"
        f"print({printed!r})\nprint({said!r}, file=sys.stderr)\nsys.exit({status})\n"
    )
    return [sys.executable, str(path)]


@pytest.mark.parametrize(
    ("printed", "status", "ok", "latency_ms", "loss"),
    [
        (IPUTILS, 0, True, 0.5, 33.3333),
        (BUSYBOX, 0, True, 0.095, 0.0),
        (SILENT, 1, False, None, 100.0),
    ],
)
def test_what_the_program_prints_is_read(
    tmp_path: Path, printed: str, status: int, ok: bool, latency_ms: float | None, loss: float
) -> None:
    found = by_program(program(tmp_path, printed, status), "192.168.1.7")
    assert (found["ok"], found["latency_ms"], found["loss_percent"]) == (ok, latency_ms, loss)


def test_a_program_that_cannot_is_no_answer_of_the_host(tmp_path: Path) -> None:
    with pytest.raises(AmberboxError, match=r"^ping: socket: Operation not permitted$"):
        by_program(program(tmp_path, "", 2, "ping: socket: Operation not permitted"), "192.168.1.7")
    with pytest.raises(AmberboxError, match="no program ping"):
        by_program([str(tmp_path / "ping")], "192.168.1.7")
