"""EtherCAT at 4 kHz: the recorder on a virtual cable, the CPU time it takes, a stop of 4 s.

Frames out and back of four slaves with ROPOD's messages (816 bytes) are sent by another process.
It needs root, for the namespaces; whole cycles are counted in the record.
"""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np
import psutil

import amberbox
from amberbox.core.errors import AmberboxError
from amberbox.testing.clock import wait_until
from benchmarks.common import Row
from tests.support.ethercat_frames import cycle
from tests.support.network_pair import NetworkPair, in_namespace
from tests.support.processes import running

RATE_HZ = 4000
SECONDS = float(os.environ.get("BENCH_ETHERCAT_S", "30"))
STOP_S = 4.0
SLAVES, OUTPUT, INPUT = 4, 168, 36


def measure() -> list[Row]:
    """Measure losses and CPU time of ``amberbox record``."""
    note = f"{RATE_HZ} cycles/s for {SECONDS:g} s, frames of {SLAVES * (OUTPUT + INPUT) + 28} bytes"
    steady, share, dropped = _record(SECONDS, 0.0)
    stopped, _, stopped_dropped = _record(max(8.0, STOP_S + 4), STOP_S)
    return [
        Row("cycles missing", steady, "", note=f"{note}; {dropped} frames dropped by the kernel"),
        Row("CPU of the recorder", 100 * share, "% of a core", note=note),
        Row(
            f"cycles missing after a stop of {STOP_S:g} s (SIGSTOP)", stopped, "",
            note=f"{stopped_dropped} frames dropped by the kernel",
        ),
    ]  # fmt: skip


def _record(seconds: float, stop_s: float) -> tuple[int, float, int]:
    """Return cycles that are missing, share of a core, frames that the kernel dropped."""
    with NetworkPair() as network, tempfile.TemporaryDirectory() as place, ExitStack() as stack:
        folder = _folder(Path(place), network.interface)
        with in_namespace(network.near):
            process = stack.enter_context(running("record", folder, log=Path(place, "log")))
        wait_until(lambda: _rows(folder, "amberbox_event", "kind").count("ethercat_open") > 0, "up")
        recorder = psutil.Process(process.pid)
        before = _cpu_s(recorder)
        sender = subprocess.Popen(
            ["ip", "netns", "exec", network.far, sys.executable, "-m", "benchmarks.ethercat",
             network.interface, str(seconds)],
        )  # fmt: skip
        if stop_s:
            time.sleep(1.0)
            os.kill(process.pid, signal.SIGSTOP)
            time.sleep(stop_s)
            os.kill(process.pid, signal.SIGCONT)
        sender.wait()
        wanted = round(seconds * RATE_HZ)
        share = (_cpu_s(recorder) - before) / seconds
        time.sleep(2.0)
        counted = [int(n) for n in _rows(folder, "ethercat_output", "slaves_0_number")]
        missing = wanted - len({*counted} & {*range(wanted)})
        return missing, share, sum(int(n) for n in _rows(folder, "ethercat_bus", "dropped"))


def _cpu_s(process: psutil.Process) -> float:
    """Return CPU seconds of a process; those of its children (low priority) are not in it."""
    times = process.cpu_times()
    return float(times.user + times.system)


def _folder(place: Path, interface: str) -> Path:
    folder = place / "robot"
    folder.mkdir()
    (folder / "robot.yaml").write_text("id: bench\nstore: {path: store}\n")
    (folder / "black_box.yaml").write_text(f"""
- ethercat:
    interfaces:
      - interface_specification:
          interface: {interface}
          number_of_slaves: {SLAVES}
          output_message_size: {OUTPUT}
          input_message_size: {INPUT}
          output_message_elements: [{{name: number, type: uint32}}]
          input_message_elements: [{{name: number, type: uint32}}]
""")
    return folder


def _rows(folder: Path, item: str, column: str) -> list[Any]:
    try:
        with amberbox.open(folder) as record:
            return list(np.asarray(record.query(item, [column])[column]))
    except AmberboxError:  # it is not there yet
        return []


def _frames(count: int) -> Iterator[tuple[bytes, bytes]]:
    sent, rest = bytes(SLAVES * INPUT), bytes(SLAVES * OUTPUT - 4)
    for number in range(count):
        yield cycle(sent, number.to_bytes(4, "little") + rest, 3 * SLAVES, number & 255)


def send(interface: str, seconds: float) -> None:
    """Send frames out and back at the rate, in step with the clock."""
    line = socket.socket(socket.AF_PACKET, socket.SOCK_RAW, 0)
    line.bind((interface, 0))
    begin_s = time.monotonic()
    for number, (out, back) in enumerate(_frames(round(seconds * RATE_HZ))):
        while time.monotonic() - begin_s < number / RATE_HZ:
            time.sleep(0.0002)
        line.send(out)
        line.send(back)


if __name__ == "__main__":
    send(sys.argv[1], float(sys.argv[2]))
