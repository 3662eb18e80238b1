"""How fast the simulated robot lives, JSON encoding included, on one core.

The target is 50 times real time.
"""

from __future__ import annotations

from functools import partial

import msgspec

from amberbox.sim.robot import Robot
from benchmarks.common import Row, cpu_s

ROBOT_S = 60.0
REPEATS = 5
SEED = 3


def measure() -> list[Row]:
    """Measure simulated seconds per CPU second, messages and bytes."""
    count, size = live(ROBOT_S)
    took_s = cpu_s(partial(live, ROBOT_S), REPEATS)
    faulty_s = cpu_s(partial(live, ROBOT_S, "laser_front_mount_turned"), REPEATS)
    speed, note = ROBOT_S / took_s, "target: 50"
    return [
        Row("nominal robot", speed, "robot seconds per CPU second", note=note),
        Row("with a turned laser", ROBOT_S / faulty_s, "robot seconds per CPU second", note=note),
        Row("messages", count / took_s, "messages per CPU second"),
        Row("messages of one robot", count / ROBOT_S, "messages/s"),
        Row("bytes of one robot", size / ROBOT_S / 1e3, "kB/s", note="JSON"),
    ]


def live(seconds: float, *faults: str) -> tuple[int, int]:
    """Let a robot live and encode what it says; return messages and bytes."""
    robot, encode = Robot(SEED), msgspec.json.Encoder().encode
    for fault in faults:
        robot.inject(fault)
    count = size = 0
    for _, _, message in robot.step_until(seconds):
        count += 1
        size += len(encode(message))
    return count, size


if __name__ == "__main__":
    for row in measure():
        print(f"{row.name:24} {row.value:12,.1f} {row.unit}")
