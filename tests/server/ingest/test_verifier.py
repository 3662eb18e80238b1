"""The worker that verifies: what kills it, and an end in the middle of its work."""

from __future__ import annotations

import os
import signal
import threading
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import pytest

from amberbox.core.errors import AmberboxError
from amberbox.server.ingest.verification import UploadClaim, VerificationResult, Verifier
from amberbox.testing.clock import PATIENCE_S

PROGRAM = "tests.server.ingest.verification_by_name"
CLAIM = UploadClaim(Path("/nowhere"), "r1", "s", "journal/000001-a-0001.mcap", "0" * 64, None, "")


def stopped(verifier: Verifier) -> int:
    """Start the worker and stop it as if it read for long; return its process."""
    with pytest.raises(OSError):
        verifier.check(CLAIM)
    [pid] = verifier.pids
    os.kill(pid, signal.SIGSTOP)
    return pid


def asked(verifier: Verifier, said: list[object]) -> threading.Thread:
    def ask() -> None:
        try:
            said.append(verifier.check(CLAIM))
        except AmberboxError as error:
            said.append(error.what)
        except OSError:
            said.append("no file")

    thread = threading.Thread(target=ask)
    thread.start()
    return thread


def test_an_end_does_not_wait_for_a_file_nor_judge_it() -> None:
    verifier, said = Verifier(), list[object]()
    stopped(verifier)
    thread = asked(verifier, said)
    verifier.close()
    thread.join(PATIENCE_S)
    assert said == ["the server stops"]


def test_a_worker_that_was_killed_is_replaced_and_the_file_looked_at_again() -> None:
    verifier, said = Verifier(), list[object]()
    process = stopped(verifier)
    thread = asked(verifier, said)
    os.kill(process, signal.SIGKILL)
    thread.join(PATIENCE_S)
    assert said == ["no file"]
    verifier.close()


def test_a_file_is_not_judged_by_what_another_one_does() -> None:
    verifier = Verifier(lambda path: 1.0 if path.name == "endless" else 60.0, PROGRAM)
    names = ("sound", "bomb", "sound", "endless", "sound")
    claims = [replace(CLAIM, path=Path(name)) for name in names]
    with ThreadPoolExecutor(len(claims)) as threads:
        found = list(threads.map(verifier.check, claims))
    verifier.close()
    assert found[1] is None and found[3] is not None
    assert found[3].reason == "to read it takes longer than it may"
    assert [found[n] for n in (0, 2, 4)] == [VerificationResult()] * 3


def test_ctrl_c_is_not_for_the_worker() -> None:
    verifier = Verifier()
    process = stopped(verifier)
    os.kill(process, signal.SIGINT)
    os.kill(process, signal.SIGCONT)
    with pytest.raises(OSError):
        verifier.check(CLAIM)
    assert verifier.pids == [process]
    verifier.close()
