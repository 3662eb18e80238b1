"""What the robot's computer pays for probes: 200 paths looked at once per second."""

from __future__ import annotations

import time

from amberbox.core.probe import ProbeOrder
from amberbox.monitoring.probing.probe import Row as ProbeRow
from amberbox.monitoring.probing.publisher import encode
from amberbox.monitoring.probing.runner import ProbeRunner
from benchmarks.common import Row

PROBES = 200
SECONDS = 10.0


def measure() -> list[Row]:
    """Run the probes for a while, each row made ready to be published."""
    rows = 0

    def put(order: ProbeOrder, row: ProbeRow) -> None:
        nonlocal rows
        encode(row)
        rows += 1

    orders = [ProbeOrder("path_exists", f"/dev/amberbox/{n}") for n in range(PROBES)]
    runner = ProbeRunner(orders, put)
    runner.start()
    time.sleep(1.5)  # the first looks load the probe and start the threads
    begin_s, cpu_s, before = time.monotonic(), time.process_time(), rows
    time.sleep(SECONDS)
    spent_s, wall_s = time.process_time() - cpu_s, time.monotonic() - begin_s
    looks = rows - before
    runner.close()
    note = f"target: 5; {looks / wall_s:.0f} looks/s, CPU time of the whole process"
    name = f"{PROBES} probes path_exists, each once per second"
    return [Row(name, 100 * spent_s / wall_s, "% of a core", note=note)]
