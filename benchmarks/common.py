"""One measured number as a row; how CPU time and rates are measured; a free port."""

from __future__ import annotations

import gc
import json
import socket
import statistics
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

from amberbox.core.errors import UsageError

T = TypeVar("T")


@dataclass(frozen=True, slots=True)
class Row:
    """One measured number, beside the same number of a peer where there is one.

    ``ratio`` says how many times better than the peer we are (above 1 is better for us),
    ``note`` how it was measured or against which target.
    """

    name: str
    value: float
    unit: str
    peer: str = ""
    ratio: float | None = None
    note: str = ""


def kept_lines(path: Path, made: Callable[..., T]) -> Iterator[T]:
    """Yield what an earlier run has kept as lines of JSON; torn lines are left out.

    Raises UsageError for lines of another version.
    """
    lines = path.read_text().splitlines() if path.exists() else []
    for number, line in enumerate(lines, start=1):
        try:
            yield made(**json.loads(line))
        except json.JSONDecodeError:
            continue
        except TypeError as error:
            what = f"{path}:{number}: is not of this version: {error}"
            raise UsageError(what, "keep it in another file") from error


@contextmanager
def meanwhile(work: Callable[[], object], every_s: float) -> Iterator[None]:
    """Call ``work`` every so often in another thread until the block is left."""
    stop = threading.Event()

    def go_on() -> None:
        while not stop.wait(every_s):
            work()

    thread = threading.Thread(target=go_on)
    thread.start()
    try:
        yield
    finally:
        stop.set()
        thread.join()


def cpu_s(work: Callable[[], object], repeats: int = 5) -> float:
    """CPU seconds of this process that ``work`` takes: the median of ``repeats`` runs."""
    return _median_s(work, repeats, time.process_time)


def wall_s(work: Callable[[], object], repeats: int = 5) -> float:
    """Wall-clock seconds that ``work`` takes: the median of ``repeats`` runs."""
    return _median_s(work, repeats, time.perf_counter)


def rate(count: int, work: Callable[[], object], repeats: int = 5) -> float:
    """How many of ``count`` pieces ``work`` does per CPU second: the median of ``repeats`` runs."""
    return count / max(cpu_s(work, repeats), 1e-9)


def free_port() -> int:
    """Return a TCP port of this computer that nobody listens at."""
    with socket.create_server(("127.0.0.1", 0)) as probe:
        return int(probe.getsockname()[1])


def percentile(values: list[float], percent: float) -> float:
    """The smallest value that at least ``percent`` of the values do not exceed."""
    ordered = sorted(values)
    rank = max(0, -int(-len(ordered) * percent // 100) - 1)
    return ordered[rank]


def _median_s(work: Callable[[], object], repeats: int, clock: Callable[[], float]) -> float:
    work()  # caches, lazy imports and compiled decoders are not what is measured
    return statistics.median(_once_s(work, clock) for _ in range(repeats))


def _once_s(work: Callable[[], object], clock: Callable[[], float]) -> float:
    gc.collect()
    gc.disable()
    try:
        start_s = clock()
        work()
        return clock() - start_s
    finally:
        gc.enable()
