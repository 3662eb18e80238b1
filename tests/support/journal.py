"""Journals of systemd without systemd: files written by ``systemd-journal-remote``."""

from __future__ import annotations

import shutil
import struct
import subprocess
import time
from collections.abc import Iterable, Mapping
from pathlib import Path

WRITER = Path("/lib/systemd/systemd-journal-remote")
BOOT = "0123456789abcdef0123456789abcdef"


def missing_journal() -> str:
    """Return why there can be no journal here; empty if there can."""
    if shutil.which("journalctl") is None or not WRITER.exists():
        return "journalctl and systemd-journal-remote are needed"
    return ""


def entry(
    message: str | bytes, at_us: int = 0, boot: str = BOOT, **fields: str | bytes
) -> Mapping[str, str | bytes]:
    """Return an entry; ``at_us`` is its wall time, now when 0."""
    at_us = at_us or time.time_ns() // 1000
    return {
        "__REALTIME_TIMESTAMP": str(at_us),
        "__MONOTONIC_TIMESTAMP": str(at_us - 1_000_000_000_000_000),
        "_BOOT_ID": boot,
        "PRIORITY": "6",
        "SYSLOG_IDENTIFIER": "test",
        "_SYSTEMD_UNIT": "rosbridge.service",
        "_PID": "4711",
        **fields,
        "MESSAGE": message,
    }


def append(file: Path, entries: Iterable[Mapping[str, str | bytes]]) -> None:
    """Append entries to a journal file, in the export format."""
    data = b"".join(_exported(one) for one in entries)
    command = [str(WRITER), f"--output={file}", "-"]
    done = subprocess.run(command, input=data, capture_output=True, check=False)
    assert done.returncode == 0, done.stderr.decode()


def _exported(fields: Mapping[str, str | bytes]) -> bytes:
    made = b""
    for name, value in fields.items():
        data = value if isinstance(value, bytes) else value.encode()
        is_plain = isinstance(value, str) and "\n" not in value
        made += (
            name.encode() + b"=" + data + b"\n"
            if is_plain
            else name.encode() + b"\n" + struct.pack("<Q", len(data)) + data + b"\n"
        )
    return made + b"\n"
