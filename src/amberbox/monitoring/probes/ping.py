"""Whether another computer answers over the network, how fast, and how much is lost."""

from __future__ import annotations

import errno
import re
import socket
import struct
import subprocess
import time
from collections.abc import Callable, Sequence

from amberbox.core.errors import AmberboxError, UsageError
from amberbox.core.probe import Measured

MEASURES = {
    "latency_ms": ("float", "ms", "there and back, mean of the answers"),
    "loss_percent": ("float", "%", "requests without an answer, of three"),
}
SUBJECT = "HOST for an echo (ICMP), or HOST:PORT for a TCP connection, such as 192.168.1.7:22"
PERIOD_S = 2.0

_COUNT = 3
_WAIT_S = 1.0
_PAUSE_S = 0.2
# errors that mean no answer (TimeoutError has no number); others: not known
_LOST = frozenset(
    {errno.ECONNREFUSED, errno.ECONNRESET, errno.ETIMEDOUT, errno.ENETUNREACH}
    | {errno.EHOSTUNREACH, errno.ENETDOWN, errno.EHOSTDOWN, None}
)

_SUBJECT = re.compile(r"(\[(?P<v6>[0-9A-Fa-f:.]+(%\w+)?)\]|(?P<host>[\w.-]+))(:(?P<port>\d+))?")
_BARE_V6 = re.compile(r"[0-9A-Fa-f]*:[0-9A-Fa-f.]*:[0-9A-Fa-f:.]*(?:%\w+)?")
_SUMMARY = re.compile(r"(?<![\d.])([\d.]+)% packet loss")
_MEAN = re.compile(r"= [\d.]+/([\d.]+)/")


def measure(subject: str) -> Measured:
    """Ping three times; ok when anything answers. Unknown if the name has no address."""
    host, port = split(subject)
    if port is not None:
        return repeated(lambda number: tcp_s(host, port))
    family, _, _, _, address = socket.getaddrinfo(host, None, type=socket.SOCK_DGRAM)[0]
    try:
        with _echo_socket(family) as echo:
            return repeated(lambda number: echo_s(echo, family, address, number))
    except PermissionError:  # the system allows only the program to do it
        return by_program(["ping"], str(address[0]))


def split(subject: str) -> tuple[str, int | None]:
    """Split ``HOST:PORT``; the port is None where only a host is named."""
    if _BARE_V6.fullmatch(subject):
        return subject, None
    found = _SUBJECT.fullmatch(subject)
    if found is None or subject.startswith("-"):
        raise UsageError(f"'{subject}' is no host", "such as 192.168.1.7 or robot:22")
    return found["v6"] or found["host"], int(found["port"]) if found["port"] else None


def repeated(ask: Callable[[int], float], pause_s: float = _PAUSE_S) -> Measured:
    """Measure the round trip several times, in seconds; an OSError is a loss."""
    times_s: list[float] = []
    error = ""
    for number in range(_COUNT):
        if number:
            time.sleep(pause_s)
        try:
            times_s.append(ask(number))
        except OSError as refused:
            if refused.errno not in _LOST:
                raise
            error = refused.strerror or "no answer"
    return {
        "ok": bool(times_s),
        "error": "" if times_s else error,
        "latency_ms": 1e3 * sum(times_s) / len(times_s) if times_s else None,
        "loss_percent": 100 * (1 - len(times_s) / _COUNT),
    }


def tcp_s(host: str, port: int) -> float:
    """Connect and close; return how long it took, in seconds."""
    begin_s = time.monotonic()
    socket.create_connection((host, port), timeout=_WAIT_S).close()
    return time.monotonic() - begin_s


def echo_s(echo: socket.socket, family: int, address: tuple[object, ...], number: int) -> float:
    """Send an echo request and wait for its answer; return how long it took, in seconds."""
    request, reply = (128, 129) if family == socket.AF_INET6 else (8, 0)
    begin_s = time.monotonic()
    end_s = begin_s + _WAIT_S
    echo.sendto(struct.pack("!BBHHH", request, 0, 0, 0, number) + b"amberbox", address)
    while (left_s := end_s - time.monotonic()) > 0:
        echo.settimeout(left_s)
        answer = echo.recv(1024)
        if answer[:1] == bytes([reply]) and answer[6:8] == number.to_bytes(2, "big"):
            return time.monotonic() - begin_s
    raise TimeoutError


def by_program(ping: Sequence[str], address: str) -> Measured:
    """Measure by running the given program ``ping``; raise AmberboxError if that fails."""
    command = [*ping, "-n", "-c", str(_COUNT), "-i", f"{_PAUSE_S:g}", "-W", "1", address]
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=3 * _WAIT_S)
    except FileNotFoundError as error:
        what = "this user may send no echo, and there is no program ping"
        raise AmberboxError(f"{what}; name a port instead: HOST:PORT") from error
    except subprocess.TimeoutExpired as error:
        raise AmberboxError("ping did not end in time") from error
    summary = _SUMMARY.search(done.stdout)
    if summary is None:
        raise AmberboxError(done.stderr.strip().partition("\n")[0] or "ping gave no summary")
    return read(float(summary[1]), _MEAN.search(done.stdout))


def read(loss_percent: float, mean: re.Match[str] | None) -> Measured:
    """Read the figures that the program printed."""
    return {
        "ok": loss_percent < 100,
        "error": "" if loss_percent < 100 else "no answer",
        "latency_ms": float(mean[1]) if mean else None,
        "loss_percent": loss_percent,
    }


def _echo_socket(family: int) -> socket.socket:
    protocol = socket.IPPROTO_ICMPV6 if family == socket.AF_INET6 else socket.IPPROTO_ICMP
    return socket.socket(family, socket.SOCK_DGRAM, protocol)
