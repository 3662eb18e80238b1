"""``amberbox install-service``: the unit it writes, that systemd likes it, and that it records."""

from __future__ import annotations

import getpass
import os
import re
import shlex
import shutil
import signal
import socket
import subprocess
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import pytest

from amberbox.agent.systemd_unit import MARK, Service, argument, command_line, service_of, unit_text
from amberbox.blackbox.robot_folder.folder import load_folder
from amberbox.cli.box import apply, installation, owner, removal
from amberbox.cli.main import main, verbs
from amberbox.core.errors import AmberboxError, UsageError
from amberbox.testing.clock import PATIENCE_S

SIM = "- sim:\n    seed: 1\n    topics: [{name: odom}]\n"
ME = getpass.getuser()


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    made = tmp_path / "robot"
    made.mkdir()
    (made / "robot.yaml").write_text("id: r\n")
    (made / "black_box.yaml").write_text(SIM)
    return made


@pytest.fixture
def service(folder: Path) -> Service:
    return service_of(load_folder(folder), "amberbox", ME)


def sections(text: str) -> dict[str, dict[str, str]]:
    """Parse a unit file like systemd, as far as Amberbox's units need it."""
    found: dict[str, dict[str, str]] = {}
    for line in text.splitlines():
        if line.startswith("["):
            current = found.setdefault(line.strip("[]"), {})
        elif line and not line.startswith("#"):
            key, _, value = line.partition("=")
            assert key not in current, f"{key} is there twice"
            current[key] = value
    return found


def test_a_recorder_that_hangs_or_dies_is_started_again(service: Service) -> None:
    unit = sections(unit_text(service))
    expected = {"Type": "notify", "WatchdogSec": "10", "Restart": "always", "RestartSec": "1",
                "KillMode": "mixed", "TimeoutStopSec": "15", "User": ME}  # fmt: skip
    assert {key: unit["Service"].get(key) for key in expected} == expected
    assert unit["Unit"]["StartLimitIntervalSec"] == "0"
    assert unit["Install"] == {"WantedBy": "multi-user.target"}
    assert "network" not in unit["Unit"]["After"]


def test_only_the_store_can_be_written(service: Service, folder: Path) -> None:
    protection = sections(unit_text(service))["Service"]
    assert protection["ProtectSystem"] == "strict"
    assert protection["NoNewPrivileges"] == "yes"
    assert protection["ReadWritePaths"] == str(folder / "store")


def test_only_a_folder_with_ethercat_gets_its_capability(service: Service, folder: Path) -> None:
    assert "AmbientCapabilities" not in unit_text(service)
    (folder / "black_box.yaml").write_text("- ethercat: {interfaces: [{interface: eth1}]}\n")
    unit = sections(unit_text(service_of(load_folder(folder), "amberbox", ME)))
    assert unit["Service"]["AmbientCapabilities"] == "CAP_NET_RAW"


def test_a_ring_elsewhere_can_be_written_if_it_is_there(service: Service) -> None:
    ring = Path("/tmp/ring")
    protection = sections(unit_text(replace(service, ring=ring)))["Service"]
    assert protection["ReadWritePaths"] == f"{service.store} -{ring}"
    assert protection["PrivateTmp"] == "no"


def test_homes_are_seen_only_if_something_lies_there(service: Service) -> None:
    home = "/".join(("", "home", "anna", "robot"))
    there = sections(unit_text(replace(service, folder=Path(home), store=Path(home, "store"))))
    assert there["Service"]["ProtectHome"] == "read-only"
    temporary = sections(unit_text(replace(service, folder=Path("/tmp/robot"))))
    assert temporary["Service"]["PrivateTmp"] == "no"


def test_a_slow_writer_gets_a_patient_watchdog(service: Service) -> None:
    unit = sections(unit_text(replace(service, write_s=30.0)))
    assert unit["Service"]["WatchdogSec"] == "120"


@pytest.mark.parametrize(
    ("word", "quoted"),
    [
        ("/data/robot", "/data/robot"),
        ("/data/my robot", '"/data/my robot"'),
        ("/data/100%", "/data/100%%"),
        ('/data/"x"\\', '"/data/\\"x\\"\\\\"'),
    ],
)
def test_words_are_quoted_for_systemd(word: str, quoted: str) -> None:
    assert argument(word) == quoted


def test_a_robot_with_monitors_is_supervised(
    service: Service, folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert "ExecReload" not in unit_text(service)
    assert " record --quiet " in command_line(service)
    (folder / "components").mkdir()
    (folder / "components" / "motor.yaml").write_text("component_name: motor\n")
    assert main(["install-service", str(folder), "--name", "amberbox-test"]) == 0
    shown = capsys.readouterr().out
    assert f" -m amberbox run --quiet {folder}\n" in shown
    assert "  ExecReload=/bin/kill -HUP $MAINPID\n" in shown


def test_a_dollar_is_no_variable(service: Service) -> None:
    assert command_line(replace(service, folder=Path("/data/a$b"))).endswith(" /data/a$$b")


@pytest.mark.skipif(
    not shutil.which("systemd-analyze"),
    reason="systemd-analyze is not there (Debian package systemd)",
)
def test_systemd_finds_nothing_wrong_with_it(service: Service, tmp_path: Path) -> None:
    odd = replace(service, folder=tmp_path / "my 100% robot", store=tmp_path / "a b")
    for number, one in enumerate((service, odd, replace(service, verb="run"))):
        path = tmp_path / f"amberbox-test{number}.service"
        path.write_text(unit_text(one))
        done = subprocess.run(["systemd-analyze", "verify", path], capture_output=True, text=True)
        complaints = [line for line in done.stderr.splitlines() if path.name in line]
        assert (done.returncode, complaints) == (0, [])


def test_the_installed_command_records_and_says_so(
    service: Service, folder: Path, tmp_path: Path
) -> None:
    command = shlex.split(sections(unit_text(service))["Service"]["ExecStart"])
    address = str(tmp_path / "notify")
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as manager:
        manager.bind(address)
        manager.settimeout(PATIENCE_S)
        environ = {**os.environ, "NOTIFY_SOCKET": address, "WATCHDOG_USEC": "200000"}
        process = subprocess.Popen(command, env=environ)
        try:
            assert manager.recv(200) == b"READY=1"
            assert sum(p.stat().st_size for p in folder.glob("store/journal/*.mcap")) > 0
            kept = re.compile(rb"WATCHDOG=1\nSTATUS=1 items, [1-9]\d* messages kept")
            while not kept.match(said := manager.recv(200)):
                assert said.startswith(b"WATCHDOG=1\nSTATUS=")
        finally:
            process.send_signal(signal.SIGTERM)
            process.wait(PATIENCE_S)
        while not (said := manager.recv(200)).startswith(b"STOPPING=1"):
            assert said.startswith(b"WATCHDOG=1")
    assert process.returncode == 0


# -- installing and taking away


def commands_of(root: Path, service: Service) -> list[Sequence[str]]:
    run: list[Sequence[str]] = []
    apply(installation(service, root), run.append)
    return run


@pytest.fixture
def root(tmp_path: Path) -> Path:
    made = tmp_path / "root"
    (made / "etc/systemd/system").mkdir(parents=True)
    return made


def test_installing_writes_the_unit_and_starts_it(
    root: Path, service: Service, folder: Path
) -> None:
    reload = ["systemctl", "daemon-reload"]
    enable = ["systemctl", "enable", "--now", "amberbox.service"]
    assert commands_of(root, service) == [reload, enable]
    path = root / "etc/systemd/system/amberbox.service"
    assert path.read_text() == unit_text(service)
    assert path.stat().st_mode & 0o777 == 0o644
    assert [entry.name for entry in path.parent.iterdir()] == [path.name]
    assert (folder / "store").is_dir() and owner(folder / "store") == ME
    assert commands_of(root, service) == [reload, enable]  # nothing has changed
    changed = replace(service, write_s=30)
    restart = ["systemctl", "try-restart", "amberbox.service"]
    assert commands_of(root, changed) == [reload, enable, restart]


def test_taking_it_away_leaves_the_record(root: Path, service: Service, folder: Path) -> None:
    commands_of(root, service)
    run: list[Sequence[str]] = []
    apply(removal(service, root), run.append)
    assert run == [
        ["systemctl", "disable", "--now", "amberbox.service"],
        ["systemctl", "daemon-reload"],
    ]
    assert list((root / "etc/systemd/system").iterdir()) == []
    assert (folder / "store").is_dir()
    with pytest.raises(UsageError, match="there is no service"):
        removal(service, root)


def test_a_unit_of_somebody_else_stays(root: Path, service: Service) -> None:
    path = root / "etc/systemd/system/amberbox.service"
    path.write_text("[Unit]\nDescription=mine\n")
    for plan in (installation, removal):
        with pytest.raises(UsageError, match="was not written by amberbox"):
            plan(service, root)
    assert path.read_text() == "[Unit]\nDescription=mine\n"


def test_a_command_that_fails_is_named(root: Path, service: Service) -> None:
    def fails(command: Sequence[str]) -> None:
        raise AmberboxError(f"{shlex.join(command)}: no")

    with pytest.raises(AmberboxError, match="systemctl daemon-reload: no"):
        apply(installation(service, root), fails)


# -- the verb


def test_the_verb_is_spelled_with_a_hyphen() -> None:
    assert "install-service" in verbs()
    assert "install_service" not in verbs()


def test_a_dry_run_shows_everything_and_changes_nothing(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    before = sorted(folder.rglob("*"))
    assert main(["install-service", str(folder), "--name", "amberbox-test"]) == 0
    shown = capsys.readouterr().out
    assert f"would make the folder {folder / 'store'} for {ME}" in shown
    assert "would write /etc/systemd/system/amberbox-test.service:" in shown
    assert f"  {MARK}" in shown
    assert f"  User={ME}" in shown
    assert "would run: systemctl enable --now amberbox-test.service" in shown
    assert "nothing has been changed; --apply does it" in shown
    assert sorted(folder.rglob("*")) == before
    assert not Path("/etc/systemd/system/amberbox-test.service").exists()


def test_without_root_nothing_is_applied(
    folder: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(os, "geteuid", lambda: 1000)
    assert main(["install-service", str(folder), "--apply"]) == 1
    errors = capsys.readouterr().err
    assert "only root can set up a service" in errors and "hint: sudo " in errors
    assert not (folder / "store").exists()


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--user", "nobody-of-that-name"], "there is no user"),
        (["--name", "My Box"], "no name for a service"),
        (["--uninstall", "--name", "amberbox-test"], "there is no service"),
    ],
)
def test_wrong_usage(
    folder: Path, options: list[str], words: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["install-service", str(folder), *options]) == 2
    assert words in capsys.readouterr().err


def test_a_folder_that_would_not_record_gets_no_service(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["install-service", str(folder / "black_box.yaml")]) == 2
    assert "is no folder" in capsys.readouterr().err
    (folder / "black_box.yaml").write_text("- sim: {sed: 1}\n")
    assert main(["install-service", str(folder)]) == 2
    assert "did you mean 'seed'" in capsys.readouterr().err
