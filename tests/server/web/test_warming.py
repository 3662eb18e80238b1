"""Templates are compiled before the first request, the most used ones first."""

from __future__ import annotations

import asyncio
from pathlib import Path

import pytest
from jinja2 import DictLoader, Environment
from jinja2.utils import LRUCache

from amberbox.core.clock import SystemClock
from amberbox.server import process
from amberbox.server.config import ServerSettings
from amberbox.server.web import page


def test_templates_are_made_ready_those_of_robots_before_others(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    made: list[str] = []

    class Noted(Environment):
        def get_template(self, name: str, *more: object) -> object:  # type: ignore[override]  # noted
            made.append(name)
            return super().get_template(name)

    names = ("admin/users.html", "base.html", "robot/tree.html")
    kept = Noted(loader=DictLoader(dict.fromkeys(names, "")))
    monkeypatch.setattr(page, "environment", lambda: kept)
    asyncio.run(page.Warming().run())
    assert made == ["base.html", "robot/tree.html", "admin/users.html"]
    assert kept.cache is not None and len(kept.cache) == len(names)


def test_the_server_does_so_and_has_room_for_all(tmp_path: Path) -> None:
    services = process.make_services(
        tmp_path, ServerSettings("https://fleet.example"), SystemClock()
    )
    parts = process.parts(services)
    process.close(services)
    assert any(isinstance(part, page.Warming) for part in parts)
    cache = page.environment().cache
    assert isinstance(cache, LRUCache)
    assert cache.capacity >= len(page.environment().list_templates())
