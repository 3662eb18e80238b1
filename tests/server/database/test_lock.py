"""One server per folder."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from amberbox.core.errors import AmberboxError, UsageError
from amberbox.server.start import ServerLock
from amberbox.testing.clock import ManualClock


def test_a_second_server_is_told_who_is_there(tmp_path: Path) -> None:
    first = ServerLock(tmp_path, ManualClock())
    with pytest.raises(UsageError) as refused:
        ServerLock(tmp_path, ManualClock())
    assert f"process {os.getpid()} on " in refused.value.what
    assert refused.value.what.endswith("since 2023-11-14T22:13:20Z")
    assert "--data" in refused.value.hint
    first.release()
    ServerLock(tmp_path, ManualClock()).release()


def test_a_killed_server_leaves_no_lock(tmp_path: Path) -> None:
    program = (
        "import sys, time; from pathlib import Path\n"
        "from amberbox.core.clock import SystemClock\n"
        "from amberbox.server.start import ServerLock\n"
        "held = ServerLock(Path(sys.argv[1]), SystemClock())\n"
        "print('held', flush=True)\n"
        "sys.stdin.read()\n"
    )
    command = [sys.executable, "-c", program, str(tmp_path)]
    pipe = subprocess.PIPE
    with subprocess.Popen(command, stdin=pipe, stdout=pipe, text=True) as server:
        assert server.stdout is not None
        assert server.stdout.readline() == "held\n"
        with pytest.raises(UsageError, match=f"process {server.pid} on "):
            ServerLock(tmp_path, ManualClock())
        server.send_signal(signal.SIGKILL)
        server.wait()
    ServerLock(tmp_path, ManualClock()).release()


def test_a_lock_that_says_nothing(tmp_path: Path) -> None:
    held = ServerLock(tmp_path, ManualClock())
    (tmp_path / "lock").write_text("[]")
    with pytest.raises(UsageError, match="it does not say which"):
        ServerLock(tmp_path, ManualClock())
    held.release()


def test_a_folder_that_is_not_there(tmp_path: Path) -> None:
    with pytest.raises(AmberboxError, match="cannot write"):
        ServerLock(tmp_path / "nowhere", ManualClock())
