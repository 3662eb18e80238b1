"""docs/server/alarms.md names every route and every key, with the defaults of the code."""

from __future__ import annotations

import re
from dataclasses import fields
from pathlib import Path

from msgspec.inspect import DataclassType, StructType, type_info

from amberbox.core.clock import NS
from amberbox.core.robot_status import SEVERITIES
from amberbox.server.alarms import outbox
from amberbox.server.alarms.alarm import AlarmSettings
from amberbox.server.alarms.recipients import Email, Notifications, Quiet, Smtp, Webhook
from amberbox.server.api import alarms, server

PAGE = (Path(__file__).parents[3] / "docs" / "server" / "alarms.md").read_text(encoding="utf-8")


def test_settings_stand_there_with_their_defaults() -> None:
    rows = dict(re.findall(r"^\| `(\w+)` \| (\S+)", PAGE, re.MULTILINE))
    defaults = AlarmSettings()
    for field in fields(AlarmSettings):
        value = getattr(defaults, field.name)
        assert field.name in rows
        if isinstance(value, float):
            assert rows[field.name] == f"{value:g}"


def test_every_key_of_notifications_is_named() -> None:
    for kind in (Notifications, Smtp, Email, Webhook, Quiet):
        form = type_info(kind)
        assert isinstance(form, DataclassType | StructType)
        for field in form.fields:
            assert re.search(rf'["`]{field.encode_name}["`]', PAGE), field.encode_name


def test_every_route_is_named() -> None:
    for _, path in (*alarms.routes.rules, *server.notification_routes.rules):
        last = path.rsplit("/", 1)[-1]
        assert path in PAGE or f".../{last}`" in PAGE, path


def test_numbers_are_those_of_the_code() -> None:
    assert f"{outbox.TRIES} times" in PAGE and Notifications().digest_above == 5
    assert Notifications().digest_s * NS == 600 * NS
    assert all(f"`{word}`" in PAGE for word in SEVERITIES)
