"""How long the disk takes: a few small writes beside the store, each made durable."""

from __future__ import annotations

import os
import tempfile
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from statistics import median

from amberbox.blackbox.doctor.finding import Finding, error, ok, warn
from amberbox.blackbox.doctor.host import Host
from amberbox.blackbox.doctor.subject import Subject

COUNT = 16
_BYTES = 65_536


def latency(subject: Subject, host: Host) -> Iterator[Finding]:
    """Measure where the store is, or will be; needs the right to write there."""
    try:
        writes, syncs = probe(subject.ground)
    except OSError as trouble:
        hint = "run the doctor as the user who records"
        yield warn("disk latency", f"not measured: {trouble.strerror}", hint)
        return
    options = subject.options
    yield judged_latency(writes, syncs, options.write_s, options.sync_s)


def probe(place: Path) -> tuple[list[float], list[float]]:
    """Return the seconds of each write and each ``fdatasync``; the file leaves no trace."""
    block = os.urandom(_BYTES)  # what a disk that compresses cannot make small
    writes, syncs = [], []
    with tempfile.TemporaryFile(dir=place, prefix=".doctor-") as file:
        for _ in range(COUNT):
            began = time.perf_counter()
            os.write(file.fileno(), block)
            written = time.perf_counter()
            os.fdatasync(file.fileno())
            writes.append(written - began)
            syncs.append(time.perf_counter() - written)
    return writes, syncs


def judged_latency(
    writes: Sequence[float], syncs: Sequence[float], write_s: float, sync_s: float
) -> Finding:
    """Judge measured seconds against the intervals that are promised."""
    found = f"write {_range(writes)}, sync {_range(syncs)} (64 kB)"
    if median(syncs) > sync_s:
        hint = (
            f"a sync takes longer than store.sync_s ({sync_s:g} s): raise it, or use a faster disk"
        )
        return error("disk latency", found, hint)
    if max(syncs) > sync_s or max(writes) > write_s:
        hint = f"at times slower than store.write_s ({write_s:g} s) or store.sync_s ({sync_s:g} s) "
        return warn("disk latency", found, f"{hint}promise; use a faster disk or raise them")
    return ok("disk latency", found)


def _range(seconds: Sequence[float]) -> str:
    return f"{1e3 * median(seconds):.1f} ms, at most {1e3 * max(seconds):.1f} ms"
