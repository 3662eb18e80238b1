"""What the robot's computer pays for probes: many paths once per second, and one look of each kind.

CPU time of this process and of the programs that it starts.
"""

from __future__ import annotations

import resource
import time

from amberbox.core.probe import ProbeOrder
from amberbox.monitoring.probe_runner import ProbeRunner, encode, load_probe
from amberbox.monitoring.probe_runner import Row as ProbeRow
from benchmarks.common import Row

PROBES = 200
SECONDS = 10.0
LOOKS = {
    ("path_exists", "/dev/null"): 200,
    ("network_interface", "lo"): 200,
    ("disk", "/"): 200,
    ("memory", "ram"): 200,
    ("process", "no_such_process"): 20,
    ("unit_active", "no-such-unit.service"): 20,
}


def measure() -> list[Row]:
    """Run many probes for a while, then one kind after the other."""
    return [_many(), *(_look(kind, subject, n) for (kind, subject), n in LOOKS.items())]


def _many() -> Row:
    looks = 0

    def put(order: ProbeOrder, row: ProbeRow) -> None:
        nonlocal looks
        encode(row)
        looks += 1

    orders = [ProbeOrder("path_exists", f"/dev/amberbox/{n}") for n in range(PROBES)]
    runner = ProbeRunner(orders, put)
    runner.start()
    time.sleep(1.5)  # the first looks load the probe and start the threads
    begin_s, cpu_s, before = time.monotonic(), _cpu_s(), looks
    time.sleep(SECONDS)
    spent_s, wall_s, looked = _cpu_s() - cpu_s, time.monotonic() - begin_s, looks - before
    runner.close()
    name = f"{PROBES} probes path_exists, each once per second"
    note = f"target: 5; {looked / wall_s:.0f} looks/s"
    return Row(name, 100 * spent_s / wall_s, "% of a core", note=note)


def _look(kind: str, subject: str, count: int) -> Row:
    probe = load_probe(kind)
    probe.measure_once(subject)
    begin_s = _cpu_s()
    for _ in range(count):
        row = probe.measure_once(subject)
    return Row(f"{kind}: one look", 1e3 * (_cpu_s() - begin_s) / count, "ms", note=row["error"])


def _cpu_s() -> float:
    whose = (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)
    usages = [resource.getrusage(who) for who in whose]
    return sum(usage.ru_utime + usage.ru_stime for usage in usages)
