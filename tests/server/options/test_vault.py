"""Secrets of settings: encrypted in the database, readable with the key beside it only."""

from __future__ import annotations

import stat
from collections.abc import Iterator
from pathlib import Path

import msgspec
import pytest
from sqlalchemy import update

from amberbox.core.errors import UsageError
from amberbox.server import settings
from amberbox.server.alarms.outbox import NotificationMessage, deliver
from amberbox.server.alarms.recipients import NAME, Email, Notifications, Smtp, Webhook
from amberbox.server.database import ServerDatabase
from amberbox.server.schema import OPTION
from amberbox.server.services.settings import mask_secrets, restore_secrets
from amberbox.server.settings import FILE, LOST
from amberbox.testing.clock import ManualClock

PASSWORD, SECRET = "the password of the mail server", "0123456789abcdef-of-the-hook"
SETTING = Notifications(
    Smtp("mail.example", sender="fleet@example.com", user="fleet", password=PASSWORD),
    (Email("night", ("anna@example.com",)),),
    (Webhook("hook", "https://hook.example/", SECRET),),
)


@pytest.fixture
def database(tmp_path: Path) -> Iterator[ServerDatabase]:
    found = ServerDatabase(tmp_path / "server.db", ManualClock())
    yield found
    found.close()


def write(database: ServerDatabase) -> None:
    with database.begin() as connection:
        settings.write(connection, 1, NAME, SETTING)


def read(database: ServerDatabase) -> Notifications:
    with database.reading() as connection:
        return settings.read(connection, NAME, Notifications)


def files_hold(folder: Path, secret: str) -> bool:
    return any(secret.encode() in path.read_bytes() for path in folder.glob("server.db*"))


def test_a_copy_of_the_database_opens_nothing(database: ServerDatabase, tmp_path: Path) -> None:
    write(database)
    assert read(database) == SETTING
    assert not files_hold(tmp_path, PASSWORD) and not files_hold(tmp_path, SECRET)
    key = tmp_path / FILE
    assert stat.S_IMODE(key.stat().st_mode) == 0o600
    key.chmod(0o644)
    assert read(database) == SETTING
    assert stat.S_IMODE(key.stat().st_mode) == 0o600, "what others could read is theirs no more"


def test_plain_secrets_of_an_earlier_version_are_encrypted(
    database: ServerDatabase, tmp_path: Path
) -> None:
    plain = msgspec.json.encode(SETTING).decode()
    with database.begin() as connection:
        row = {"name": NAME, "value": plain.replace(SECRET, "an-earlier-secret" * 400)}
        connection.execute(OPTION.insert(), [{**row, "changed_ns": 1}])
    with database.begin() as connection:
        connection.execute(update(OPTION).values(value=plain))
    assert read(database) == SETTING and files_hold(tmp_path, SECRET)
    with database.begin() as connection:
        assert settings.seal_plain(connection)
        assert not settings.seal_plain(connection), "once"
    database.forget_deleted()
    assert read(database) == SETTING
    for secret in (PASSWORD, SECRET, "an-earlier-secret"):
        assert not files_hold(tmp_path, secret)


@pytest.mark.parametrize("instead", [None, "", "no key", "A" * 43 + "="])
def test_without_the_key_it_is_said_and_they_can_be_entered_again(
    database: ServerDatabase, tmp_path: Path, instead: str | None
) -> None:
    write(database)
    key = tmp_path / FILE
    held = key.read_text()
    key.unlink()
    if instead is not None:
        key.write_text(instead)
    found = read(database)
    assert found.has_lost_secrets and found.emails == SETTING.emails, "all else stays"
    for to in found.destinations():
        trouble = deliver(to, NotificationMessage("k", "it", "it"), found, 0)
        assert trouble.startswith("its secret cannot be read: the file secrets.key")
    shown = mask_secrets(msgspec.to_builtins(found))
    assert shown["smtp"]["password"] == "" and shown["webhooks"][0]["secret"] == ""
    with pytest.raises(UsageError, match="write it again"):
        restore_secrets({"password": "***"}, {"password": LOST})
    key.write_text(held)
    assert read(database) == SETTING, "with the key put back"
    key.unlink()
    write(database)
    assert read(database) == SETTING, "entered again, with a new key"
    assert key.read_text() != held
