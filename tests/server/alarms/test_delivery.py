"""Deliver messages to real peers: a mail server and a web server on loopback."""

from __future__ import annotations

import hashlib
import hmac
import json

from amberbox.core.clock import NS
from amberbox.server.alarms.outbox import DELIVERY, SIGNATURE, NotificationMessage, deliver
from amberbox.server.alarms.recipients import Email, Notifications, Smtp, Webhook
from tests.server.alarms.receivers import hook_server, mail_server

NOW_NS = 1_800_000_000 * NS
SECRET = "0123456789abcdef"
MESSAGE = NotificationMessage(
    "k1",
    "fatal: r1 laser\r\nBcc: all@example.com",
    "It is gone — für immer.",
    {"type": "alarm", "id": 7},
)
TECHNICIANS = Email("technicians", ("anna@example.com", "bo@example.com"))


def mail_setting(port: int, **more: str) -> Notifications:
    smtp = Smtp("127.0.0.1", port, sender="fleet@example.com", **{"security": "none", **more})  # type: ignore[arg-type] # words
    return Notifications(smtp, (TECHNICIANS,))


def test_a_mail_arrives_at_all_addresses() -> None:
    with mail_server() as server:
        assert deliver(TECHNICIANS, MESSAGE, mail_setting(server.port), NOW_NS) == ""
    (mail,) = server.mails
    assert server.recipients == ["anna@example.com", "bo@example.com"]
    assert mail["Subject"] == "[amberbox] fatal: r1 laser  Bcc: all@example.com"
    assert mail["Bcc"] is None
    assert mail["Message-ID"] == "<k1@amberbox.invalid>"
    assert "für immer" in mail.get_content()  # type: ignore[attr-defined] # of the new policy
    assert server.logins == []


def test_what_the_server_refuses_has_not_arrived() -> None:
    with mail_server() as server:
        server.refuse = 2
        trouble = deliver(TECHNICIANS, MESSAGE, mail_setting(server.port), NOW_NS)
    assert "451" in trouble and server.mails == []


def test_a_server_without_tls_gets_no_password() -> None:
    with mail_server() as server:
        setting = mail_setting(server.port, security="starttls", user="fleet", password="secret")
        trouble = deliver(TECHNICIANS, MESSAGE, setting, NOW_NS)
    assert "STARTTLS" in trouble
    assert server.logins == [] and server.mails == []


def test_nobody_there_is_told_in_a_line() -> None:
    trouble = deliver(TECHNICIANS, MESSAGE, mail_setting(1), NOW_NS)
    assert trouble.startswith("ConnectionRefusedError")


def test_a_host_that_is_no_name_is_told_in_a_line() -> None:
    hook = Webhook("hook", "https://hooks..example/", SECRET)
    assert "label empty" in deliver(hook, MESSAGE, Notifications(), NOW_NS)


def test_a_webhook_is_signed() -> None:
    with hook_server() as hook:
        assert deliver(Webhook("h", hook.url, SECRET), MESSAGE, Notifications(), NOW_NS) == ""
    assert hook.paths == ["/alarms?of=fleet"]
    body = json.loads(hook.bodies[0])
    assert (body["id"], body["delivery"]) == (7, "k1")
    assert hook.headers[0][DELIVERY] == "k1"
    signed = hmac.new(SECRET.encode(), b"1800000000." + hook.bodies[0], hashlib.sha256)
    assert hook.headers[0][SIGNATURE] == f"t=1800000000,v1={signed.hexdigest()}"


def test_redirects_are_not_followed() -> None:
    with hook_server() as hook, hook_server() as other:
        hook.status, hook.location = 307, other.url
        trouble = deliver(Webhook("h", hook.url, SECRET), MESSAGE, Notifications(), NOW_NS)
    assert trouble == "the answer was 307: redirects are not followed"
    assert other.bodies == []


def test_an_error_of_the_receiver_is_told() -> None:
    with hook_server() as hook:
        hook.status = 500
        trouble = deliver(Webhook("h", hook.url, SECRET), MESSAGE, Notifications(), NOW_NS)
    assert trouble == "the answer was 500"
