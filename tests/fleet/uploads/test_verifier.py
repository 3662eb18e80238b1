"""The worker that verifies: what kills it, and an end in the middle of its work."""

from __future__ import annotations

import os
import signal
import threading
from pathlib import Path

import pytest

from amberbox.core.errors import AmberboxError
from amberbox.fleet.uploads.verifying import Claim, Verifier

CLAIM = Claim(Path("/nowhere"), "r1", "s", "journal/000001-a-0001.mcap", "0" * 64, None, "")


def stopped(verifier: Verifier) -> int:
    """Start the worker and stop it as if it read for long; return its process."""
    with pytest.raises(OSError):
        verifier.check(CLAIM)
    assert verifier._pool is not None
    [process] = verifier._pool._processes.values()
    assert process.pid is not None
    os.kill(process.pid, signal.SIGSTOP)
    return process.pid


def asked(verifier: Verifier, said: list[object]) -> threading.Thread:
    def ask() -> None:
        try:
            said.append(verifier.check(CLAIM))
        except AmberboxError as error:
            said.append(error.what)

    thread = threading.Thread(target=ask)
    thread.start()
    return thread


def test_an_end_does_not_wait_for_a_file_nor_judge_it() -> None:
    verifier, said = Verifier(), list[object]()
    stopped(verifier)
    thread = asked(verifier, said)
    verifier.close()
    thread.join(5)
    assert said == ["the server stops"]


def test_a_worker_that_dies_over_a_file_is_replaced() -> None:
    verifier, said = Verifier(), list[object]()
    process = stopped(verifier)
    thread = asked(verifier, said)
    os.kill(process, signal.SIGKILL)
    thread.join(5)
    assert said == [None]
    with pytest.raises(OSError):
        verifier.check(CLAIM)  # another one looks, and finds no file
    verifier.close()


def test_ctrl_c_is_not_for_the_worker() -> None:
    verifier = Verifier()
    process = stopped(verifier)
    os.kill(process, signal.SIGINT)
    os.kill(process, signal.SIGCONT)
    with pytest.raises(OSError):
        verifier.check(CLAIM)
    assert verifier._pool is not None and process in verifier._pool._processes
    verifier.close()
