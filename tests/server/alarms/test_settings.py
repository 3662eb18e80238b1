"""Settings of notifications: refused values, and quiet hours."""

from __future__ import annotations

from typing import Any

import pytest

from amberbox.core.errors import UsageError
from amberbox.core.timestamps import format_time, parse_any_time
from amberbox.server.alarms.recipients import Notifications, Quiet, check_url
from amberbox.server.settings import parsed

SMTP = {"host": "mail.example", "sender": "fleet@example.com"}
HOOK = {"name": "h", "url": "https://hook.example/x", "secret": "0123456789abcdef"}
MAIL = {"name": "m", "to": ["anna@example.com"]}


@pytest.mark.parametrize(
    "url",
    [
        "ftp://hook.example/", "https://", "https://user:pw@hook.example/", "https://a b.example/",
        "http://hook.example/", "https://169.254.169.254/latest", "https://0.0.0.0/",
        "https://224.0.0.1/", "https://[fe80::1]/", "https://[::ffff:169.254.169.254]/",
        "https://hook.example:99999/", "file:///etc",
        "https://hook.example/#x", "https://hook.example/\r\nX: y", "//hook.example", "",
    ],
)  # fmt: skip
def test_an_address_that_is_none_is_refused(url: str) -> None:
    with pytest.raises(ValueError, match="url: "):
        check_url(url)


@pytest.mark.parametrize(
    "url", ["https://hook.example/a?b=c", "http://10.1.2.3:8080/", "http://localhost/x"]
)
def test_an_address_of_a_program_is_taken(url: str) -> None:
    check_url(url)


@pytest.mark.parametrize(
    ("value", "what"),
    [
        ({"emails": [MAIL]}, "mails need a mail server"),
        ({"smtp": {**SMTP, "user": "u", "security": "none"}}, "without TLS"),
        ({"smtp": {**SMTP, "password": "***"}}, "enter it again"),
        ({"smtp": {**SMTP, "host": "a b"}}, "no mail server"),
        ({"smtp": SMTP, "emails": [{**MAIL, "to": ["x@y\nBcc: z@z"]}]}, "no address"),
        ({"smtp": SMTP, "emails": [{**MAIL, "to": []}]}, "one address at least"),
        ({"webhooks": [{**HOOK, "secret": "short"}]}, "16 characters"),
        ({"webhooks": [{**HOOK, "secret": "***"}]}, "16 characters"),
        ({"webhooks": [HOOK, HOOK]}, "there twice"),
        ({"webhooks": [{**HOOK, "quiet": {"from": "22:00", "to": "x"}}]}, "isoformat"),
        ({"webhooks": [{**HOOK, "quiet": {"from": "22:00", "to": "06:00", "zone": "Mars"}}]},
         "no time zone"),
        ({"webhooks": [{**HOOK, "least": "dreadful"}]}, "dreadful"),
        ({"webhooks": [{**HOOK, "quiet": {"from": "22:00+01:00", "to": "06:00"}}]},
         "without an offset"),
        ({"digest_above": 0}, "digest_above"),
    ],
)  # fmt: skip
def test_settings_that_make_no_sense_are_refused(value: dict[str, Any], what: str) -> None:
    with pytest.raises(UsageError, match=what):
        parsed(value, Notifications)


def test_settings_are_read() -> None:
    setting = parsed({"smtp": SMTP, "emails": [MAIL], "webhooks": [HOOK]}, Notifications)
    assert [one.name for one in setting.destinations()] == ["m", "h"]
    assert "0123456789abcdef" not in repr(setting)


@pytest.mark.parametrize(
    ("at", "until"),
    [
        ("2026-07-01T21:30:00Z", "2026-07-02T04:00:00"),  # 23:30 in Berlin
        ("2026-07-02T03:59:00Z", "2026-07-02T04:00:00"),
        ("2026-07-02T04:00:00Z", None),
        ("2026-07-02T12:00:00Z", None),
    ],
)
def test_quiet_hours_are_those_of_the_zone(at: str, until: str | None) -> None:
    quiet = Quiet("22:00", "06:00", "Europe/Berlin")
    found = quiet.until_ns(parse_any_time(at, lambda: 0, lambda: None))
    assert (None if found is None else format_time(found)[:19]) == until
