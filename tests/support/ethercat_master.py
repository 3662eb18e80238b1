"""A SOEM master (pysoem) on an interface; prints what it saw in each cycle.

``python -m tests.support.ethercat_master INTERFACE`` maps the slaves and brings them to OP, then
prints ``ready EXPECTED``. It takes lines ``N TIMEOUT``: N cycles, each with a timeout in us; it
answers with a list of them in JSON: working counter, bytes sent, bytes received.
"""

from __future__ import annotations

import json
import random
import sys
import time
from typing import Any

import pysoem  # type: ignore[import-untyped]  # the package has no type hints

_STEP_S = 0.002
_PATIENCE_US = 2_000_000


def main(interface: str) -> None:
    """Map the slaves, and run cycles as told until the input ends."""
    master: Any = pysoem.Master()
    master.open(interface)
    timeouts = pysoem.settings.timeouts
    timeouts.ret = timeouts.safe = timeouts.eeprom = 1_000_000  # the slaves run beside other tests
    if master.config_init() <= 0:
        sys.exit("no slaves")
    master.config_map()
    master.state_check(pysoem.SAFEOP_STATE, 5_000_000)
    master.send_processdata()
    master.receive_processdata(_PATIENCE_US)
    master.state = pysoem.OP_STATE
    master.write_state()
    for _ in range(100):
        master.send_processdata()
        master.receive_processdata(_PATIENCE_US)
        if master.state_check(pysoem.OP_STATE, 50_000) == pysoem.OP_STATE:
            break
    else:
        sys.exit("the slaves do not reach OP")
    print("ready", master.expected_wkc, flush=True)
    chance = random.Random(7)
    for line in sys.stdin:
        cycles, timeout_us = map(int, line.split())
        found = [_cycle(master, chance, timeout_us) for _ in range(cycles)]
        print(json.dumps(found), flush=True)
    master.close()


def _cycle(master: Any, chance: random.Random, timeout_us: int) -> tuple[int, str, str]:
    for slave in master.slaves:
        slave.output = chance.randbytes(len(slave.output))
    master.send_processdata()
    counter = master.receive_processdata(timeout_us)
    sent = b"".join(slave.output for slave in master.slaves)
    received = b"".join(slave.input for slave in master.slaves)
    time.sleep(_STEP_S)
    return counter, sent.hex(), received.hex()


if __name__ == "__main__":
    main(sys.argv[1])
