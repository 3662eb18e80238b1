"""Deliver one message: by mail or by HTTP, to addresses of the settings and nobody else."""

from __future__ import annotations

import hashlib
import hmac
import http.client
import json
import smtplib
import ssl
from collections.abc import Callable
from datetime import UTC, datetime
from email.message import EmailMessage
from email.utils import format_datetime
from typing import Final, TypeAlias
from urllib.parse import urlsplit

from amberbox.core.clock import NS
from amberbox.core.showing import one_line
from amberbox.fleet.notifying.message import Message
from amberbox.fleet.notifying.settings import (
    LOST_HINT,
    Destination,
    Email,
    Notifications,
    Smtp,
    Webhook,
)
from amberbox.fleet.options.vault import LOST

TIMEOUT_S: Final = 10.0
SIGNATURE: Final = "Amberbox-Signature"
DELIVERY: Final = "Amberbox-Delivery"

Deliver: TypeAlias = Callable[[Destination, Message, Notifications, int], str]
"""Returns what went wrong, empty for nothing."""


def deliver(to: Destination, message: Message, setting: Notifications, now_ns: int) -> str:
    """Deliver a message; return what went wrong in a line, empty if it arrived."""
    try:
        if LOST in (to.secret if isinstance(to, Webhook) else "", _password(to, setting)):
            return f"its secret cannot be read: {LOST_HINT}"
        if isinstance(to, Webhook):
            return _post(to, message, now_ns)
        if setting.smtp is None:
            return "there is no mail server in the settings"
        return _mail(to, message, setting.smtp, now_ns)
    except (OSError, ValueError, smtplib.SMTPException, http.client.HTTPException) as error:
        # a host may be no name at all, which is a ValueError
        return one_line(f"{type(error).__name__}: {error}")[:500]


def _password(to: Destination, setting: Notifications) -> str:
    return "" if setting.smtp is None or isinstance(to, Webhook) else setting.smtp.password


def _mail(to: Email, message: Message, smtp: Smtp, now_ns: int) -> str:
    context = ssl.create_default_context()
    kind = "tls" if smtp.security == "tls" else ""
    server: smtplib.SMTP
    if kind:
        server = smtplib.SMTP_SSL(smtp.host, smtp.port, timeout=TIMEOUT_S, context=context)
    else:
        server = smtplib.SMTP(smtp.host, smtp.port, timeout=TIMEOUT_S)
    with server:
        if smtp.security == "starttls":
            server.starttls(context=context)
        if smtp.user:
            server.login(smtp.user, smtp.password)
        refused = server.send_message(_email(to, message, smtp, now_ns), smtp.sender, to.to)
    return f"refused: {', '.join(refused)}" if refused else ""


def _email(to: Email, message: Message, smtp: Smtp, now_ns: int) -> EmailMessage:
    mail = EmailMessage()
    mail["Subject"] = one_line(f"[amberbox] {message.subject}")
    mail["From"] = smtp.sender
    mail["To"] = ", ".join(to.to)
    mail["Date"] = format_datetime(datetime.fromtimestamp(now_ns // NS, UTC))
    mail["Message-ID"] = f"<{message.key}@amberbox.invalid>"
    if message.thread and message.thread != message.key:
        mail["In-Reply-To"] = mail["References"] = f"<{message.thread}@amberbox.invalid>"
    mail["Auto-Submitted"] = "auto-generated"
    mail.set_content(message.body + "\n")
    return mail


def _post(to: Webhook, message: Message, now_ns: int) -> str:
    """Post JSON; a redirect is an error: what it names is no address of the settings."""
    body = json.dumps({"delivery": message.key, "subject": message.subject, **message.data})
    data = body.encode()
    parts = urlsplit(to.url)
    path = parts._replace(scheme="", netloc="").geturl() or "/"
    headers = {
        "Content-Type": "application/json",
        "User-Agent": "amberbox",
        DELIVERY: message.key,
        SIGNATURE: signature(to.secret, now_ns // NS, data),
    }
    connection = _connection(parts.scheme, parts.hostname or "", parts.port)
    try:
        connection.request("POST", path, data, headers)
        answer = connection.getresponse()
    finally:
        connection.close()
    if 200 <= answer.status < 300:
        return ""
    more = ": redirects are not followed" if 300 <= answer.status < 400 else ""
    return f"the answer was {answer.status}{more}"


def _connection(scheme: str, host: str, port: int | None) -> http.client.HTTPConnection:
    if scheme == "https":
        context = ssl.create_default_context()
        return http.client.HTTPSConnection(host, port, timeout=TIMEOUT_S, context=context)
    return http.client.HTTPConnection(host, port, timeout=TIMEOUT_S)


def signature(secret: str, at_s: int, body: bytes) -> str:
    """Return what proves who sent a body, and when: HMAC-SHA256 of ``{at_s}.{body}``."""
    signed = hmac.new(secret.encode(), f"{at_s}.".encode() + body, hashlib.sha256).hexdigest()
    return f"t={at_s},v1={signed}"
