"""``amberbox serve add-user``: an admin without a browser, before the first start and after it."""

from __future__ import annotations

import io
import json
from collections.abc import Sequence
from pathlib import Path

import pytest
from sqlalchemy import select

from amberbox.cli.main import main
from amberbox.link.limits import NOT_SET_UP, why_unavailable
from amberbox.server.accounts.passwords import Passwords
from amberbox.server.accounts.users import User, list_users
from amberbox.server.database import FILE, ServerDatabase
from amberbox.server.schema import AUDIT, USERS
from tests.cli.test_serve import PASSWORD, started


@pytest.fixture
def data(tmp_path: Path) -> Path:
    return tmp_path / "srv"


def add(monkeypatch: pytest.MonkeyPatch, data: Path, *words: str, password: str = PASSWORD) -> int:
    """Add a user whose password is piped in."""
    monkeypatch.setattr("sys.stdin", io.StringIO(f"{password}\n" if password else ""))
    return main(["serve", "add-user", *words, "--data", str(data)])


def users_of(data: Path) -> Sequence[User]:
    database = ServerDatabase(data / FILE, read_only=True)
    try:
        with database.reading() as connection:
            return list_users(connection)
    finally:
        database.close()


def test_the_first_admin_is_there_before_the_first_start(
    data: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert add(monkeypatch, data, "anna") == 0
    assert capsys.readouterr().out == "anna is an admin now\n"
    assert data.stat().st_mode & 0o077 == 0
    assert add(monkeypatch, data, "bo") == 0
    assert add(monkeypatch, data, "cy", "--role", "operator", "--one-time", password="") == 0
    said, _, password = capsys.readouterr().out.strip().rpartition("one-time password: ")
    assert "cy is an operator now" in said
    assert [(u.name, u.role, u.must_change) for u in users_of(data)] == [
        ("anna", "admin", False), ("bo", "viewer", False), ("cy", "operator", True),
    ]  # fmt: skip
    database, hashes = ServerDatabase(data / FILE, read_only=True), Passwords()
    with database.reading() as connection:
        held = dict(connection.execute(select(USERS.c.name, USERS.c.password_hash)).all())
        log = connection.execute(select(AUDIT.c.principal, AUDIT.c.action, AUDIT.c.object)).all()
        details = connection.execute(select(AUDIT.c.details)).scalars().all()
    assert hashes.verify(held["anna"], PASSWORD) and hashes.verify(held["cy"], password)
    assert [row[1:] for row in log] == [("users.add", name) for name in ("anna", "bo", "cy")]
    assert all(row[0].startswith("shell:") for row in log)
    assert not any(PASSWORD in str(told) or password in str(told) for told in details)
    hashes.close()
    database.close()
    assert main(["serve", "verify-audit", "--data", str(data)]) == 0


@pytest.mark.parametrize(
    ("words", "password", "what"),
    [
        (["anna"], "", "no password was given"),
        (["anna"], "password1", "this password is refused"),
        (["anna", "--role", "admn"], PASSWORD, "did you mean 'admin'"),
        (["Anna Lee"], PASSWORD, "not a name of a person"),
        (["anna", "--group", "ward"], PASSWORD, "there is no group 'ward'"),
        ([], PASSWORD, "takes one NAME"),
        (["anna", PASSWORD], PASSWORD, "takes one NAME"),
    ],
)
def test_what_cannot_be_is_refused_and_nobody_added(
    data: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str],
    words: list[str], password: str, what: str,
) -> None:  # fmt: skip
    assert add(monkeypatch, data, *words, password=password) == 2
    assert what in capsys.readouterr().err
    assert not (data / FILE).exists() or users_of(data) == []


def test_it_is_asked_twice_on_a_terminal(
    data: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    typed = iter([PASSWORD, "something else entirely", PASSWORD, PASSWORD])
    monkeypatch.setattr("getpass.getpass", lambda question: next(typed))
    monkeypatch.setattr("sys.stdin.isatty", lambda: True, raising=False)
    line = ["serve", "add-user", "anna", "--data", str(data)]
    assert main(line) == 2
    assert "two different passwords" in capsys.readouterr().err
    assert main(line) == 0


def test_a_robot_that_joins_too_early_hears_it_and_the_server_goes_on(
    data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """While it runs: a robot joins before there is an admin, then an admin is added."""
    data.mkdir()
    data.chmod(0o755)
    server = started(data)
    try:
        status, body, _ = server.ask("/api/v1/robots")
        assert (status, json.loads(body)["error"]["code"]) == (503, NOT_SET_UP)
        robot = tmp_path / "r1"
        robot.mkdir()
        (robot / "robot.yaml").write_text("id: r1\n")
        (robot / "black_box.yaml").write_text("- sim:\n")
        assert main(["serve", "add-robot", "r1", "--data", str(data)]) == 0
        line = capsys.readouterr().out.strip()
        assert main(["join", str(robot), line]) == 1
        said = capsys.readouterr().out
        assert "503: it is not set up yet" in said and "serve add-user" in said
        assert (data / "setup-code").exists()
        assert add(monkeypatch, data, "anna") == 0
        assert not (data / "setup-code").exists()
        capsys.readouterr()
        assert main(["join", str(robot), line]) == 0
        assert server.ask("/setup")[0] == 404
    finally:
        _, said_by_server = server.stop()
    assert f"everybody on this computer can read {data} (mode 0755)" in said_by_server
    assert f"hint: chmod -R o-rwx {data}" in said_by_server


@pytest.mark.parametrize(
    ("body", "words"),
    [
        (b'{"error": {"what": "x", "hint": "", "code": "not_set_up"}}', "it is not set up yet"),
        (b'{"error": {"what": "the database is busy", "hint": ""}}', "the database is busy"),
        (b'{"error": {"what": "this server is not set up yet", "hint": ""}}', "not set up yet"),
        (b"<html>Bad Gateway", "it is too busy, or not set up yet"),
        (b"[]", "it is too busy, or not set up yet"),
        (b'{"error": "x"}', "it is too busy, or not set up yet"),
        (b"", "it is too busy, or not set up yet"),
    ],
)
def test_a_robot_says_why_a_server_is_not_available(body: bytes, words: str) -> None:
    assert words in why_unavailable(body)
