"""Units of systemd, by what a program in its place prints, and by this computer's own."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path

import pytest

from amberbox.core.errors import AmberboxError, UsageError
from amberbox.monitoring.probes.unit_active import ask, measure, read


def systemctl(folder: Path, code: str) -> Sequence[str]:
    script = folder / "systemctl.py"
    script.write_text(code)
    return [sys.executable, str(script)]


@pytest.mark.parametrize(
    ("shown", "ok", "state", "detail", "restarts"),
    [
        ("NRestarts=2\nLoadState=loaded\nActiveState=active\nSubState=running", True, "active",
         "running", 2),
        ("LoadState=loaded\nActiveState=active\nSubState=mounted", True, "active", "mounted", None),
        ("NRestarts=7\nLoadState=loaded\nActiveState=activating\nSubState=auto-restart", False,
         "activating", "auto-restart", 7),
        ("NRestarts=0\nLoadState=loaded\nActiveState=failed\nSubState=failed", False, "failed",
         "failed", 0),
        ("NRestarts=0\nLoadState=not-found\nActiveState=active\nSubState=running", True, "active",
         "running", 0),
    ],
)  # fmt: skip
def test_what_systemd_says_is_read(
    shown: str, ok: bool, state: str, detail: str, restarts: int | None
) -> None:
    assert read(shown) == {"ok": ok, "state": state, "detail": detail, "restarts": restarts}


def test_a_unit_that_is_not_there_is_not_ok() -> None:
    shown = "NRestarts=0\nLoadState=not-found\nActiveState=inactive\nSubState=dead\n"
    assert read(shown) == {"ok": False, "state": "not-found"}


@pytest.mark.parametrize(
    ("subject", "arguments"),
    [
        ("rosbridge.service", ["show", "--no-pager"]),
        ("user/driver", ["--user", "show", "--no-pager"]),
    ],
)
def test_systemctl_is_only_asked_to_show(
    tmp_path: Path, subject: str, arguments: Sequence[str]
) -> None:
    code = "import sys\nprint('ActiveState=active\\nSubState=' + '|'.join(sys.argv[1:]))"
    found = ask(systemctl(tmp_path, code), subject)
    properties = "--property=LoadState,ActiveState,SubState,NRestarts"
    unit = subject.removeprefix("user/")
    assert found["detail"] == "|".join([*arguments, properties, "--", unit])


def test_where_systemd_does_not_run_nothing_is_known(tmp_path: Path) -> None:
    code = "import sys\nsys.exit('System has not been booted with systemd\\nas init system')"
    with pytest.raises(AmberboxError, match=r"^systemctl: System has not been booted"):
        ask(systemctl(tmp_path, code), "rosbridge")
    with pytest.raises(AmberboxError, match="systemctl gave no state"):
        ask(systemctl(tmp_path, ""), "rosbridge")
    with pytest.raises(FileNotFoundError):
        ask([str(tmp_path / "systemctl")], "rosbridge")


@pytest.mark.parametrize("subject", ["", "--help", "root/x", "user/"])
def test_what_is_no_unit_is_refused(subject: str) -> None:
    with pytest.raises(UsageError, match="no systemd unit"):
        ask(["systemctl"], subject)


def test_this_computers_own_systemd_is_asked_where_it_runs() -> None:
    runs = Path("/run/systemd/system").is_dir()
    try:
        found = measure("amberbox-no-such-unit.service")
    except (AmberboxError, OSError):
        assert not runs
    else:
        assert found == {"ok": False, "state": "not-found"}
