"""The keeper beside the recorder: a process of its own, started again when it dies."""

from __future__ import annotations

import os
import subprocess
import sys
import time

from amberbox.blackbox.keeper.options import KeeperOptions
from amberbox.blackbox.recorder.pipeline import Pipeline

_PAUSE_S = 10.0
_STOP_S = 10.0


class KeeperProcess:
    """Runs ``amberbox.blackbox.keeper`` on the recorder's store."""

    def __init__(self, pipeline: Pipeline, options: KeeperOptions) -> None:
        module = ["-m", "amberbox.blackbox.keeper", str(pipeline.store.path)]
        parent = ["--parent", str(os.getpid())]
        self._command = [sys.executable, *module, "--options", options.to_json(), *parent]
        self._pipeline = pipeline
        self._process: subprocess.Popen[bytes] | None = None
        self._not_before = 0.0
        self._trouble = ""

    def look_after(self) -> None:
        """Start the keeper if it is not running, at most every ten seconds."""
        now = time.monotonic()
        if now < self._not_before or (self._process and self._process.poll() is None):
            return
        self._not_before = now + _PAUSE_S
        if self._process is not None:
            self._tell(f"ended with status {self._process.returncode}")
        try:
            self._process = subprocess.Popen(self._command, stdin=subprocess.DEVNULL)
        except OSError as error:
            self._tell(f"cannot be started: {error.strerror}")

    def _tell(self, trouble: str) -> None:
        """Say once what is wrong; recording goes on without segments."""
        if trouble != self._trouble:
            self._trouble = trouble
            text = f"the keeper {trouble}; it is started again every {_PAUSE_S:.0f} s"
            self._pipeline.event("keeper", text)

    def stop(self) -> None:
        """Let it finish what it is doing."""
        if self._process is not None:
            self._process.terminate()
            try:
                self._process.wait(_STOP_S)
            except subprocess.TimeoutExpired:
                self._process.kill()
                self._process.wait()
