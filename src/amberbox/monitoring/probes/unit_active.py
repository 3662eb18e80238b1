"""Whether a systemd unit is active, such as the service of a driver."""

from __future__ import annotations

import subprocess
from collections.abc import Sequence

from amberbox.core.errors import AmberboxError, UsageError
from amberbox.core.probe import Measured

MEASURES = {
    "state": ("string", "", "active, inactive, failed, activating ...; not-found: there is none"),
    "detail": ("string", "", "systemd's finer state, such as running, exited, auto-restart"),
    "restarts": ("int", "", "how often systemd has started it again by itself"),
}
SUBJECT = "name of the unit, such as rosbridge.service or rosbridge; user/NAME for a user's unit"
PERIOD_S = 2.0

_PROPERTIES = "LoadState,ActiveState,SubState,NRestarts"
_ACTIVE = ("active", "reloading", "refreshing")
_WAIT_S = 3.0


def measure(subject: str) -> Measured:
    """Query systemd; needs no privileges. Unknown where systemd does not run."""
    return ask(["systemctl"], subject)


def ask(systemctl: Sequence[str], subject: str) -> Measured:
    """Query with the given command for ``systemctl``; raise AmberboxError if it fails."""
    user, _, unit = subject.rpartition("/")
    if not unit or unit.startswith("-") or user not in ("", "user"):
        raise UsageError(f"'{subject}' is no systemd unit", "such as rosbridge.service")
    whose = ["--user"] if user else []
    command = [*systemctl, *whose, "show", "--no-pager", f"--property={_PROPERTIES}", "--", unit]
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=_WAIT_S)
    except subprocess.TimeoutExpired as error:
        raise AmberboxError(f"systemctl gives no answer within {_WAIT_S:g} s") from error
    if done.returncode != 0:
        text = done.stderr.strip().partition("\n")[0]
        raise AmberboxError(f"systemctl: {text or f'status {done.returncode}'}")
    return read(done.stdout)


def read(shown: str) -> Measured:
    """Read what ``systemctl show`` printed."""
    values = dict(line.split("=", 1) for line in shown.splitlines() if "=" in line)
    if "ActiveState" not in values:
        raise AmberboxError("systemctl gave no state")
    state = values["ActiveState"]
    if values.get("LoadState") == "not-found" and state == "inactive":
        return {"ok": False, "state": "not-found"}
    restarts = values.get("NRestarts", "")
    return {
        "ok": state in _ACTIVE,
        "state": state,
        "detail": values.get("SubState"),
        "restarts": int(restarts) if restarts.isdecimal() else None,
    }
