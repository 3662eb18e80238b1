"""The page about data on the server names every route, form and state."""

from __future__ import annotations

from pathlib import Path
from typing import get_args

import pytest

from amberbox.fleet.api import (
    downloads,
    fetches,
    incidents,
    items,
    missions,
    query,
    recordings,
)
from amberbox.fleet.api.access import PREFIX, Routes
from amberbox.fleet.data import journals
from amberbox.fleet.data.asked import Form
from amberbox.fleet.fetches import ledger as fetch_ledger
from amberbox.fleet.jobs import ledger as job_ledger
from amberbox.fleet.jobs.wanted import Downloads, Format

PAGE = Path(__file__).parents[3] / "docs" / "server_data.md"
ROOMS = (downloads, fetches, incidents, items, missions, query, recordings)
WORDS = [
    *get_args(Form), *get_args(Format), *get_args(journals.Integrity), *get_args(journals.State),
    *get_args(job_ledger.State), *get_args(fetch_ledger.State),
    *Downloads.__dataclass_fields__,
]  # fmt: skip


@pytest.mark.parametrize("word", sorted(set(WORDS)))
def test_every_word_is_explained(word: str) -> None:
    assert f"`{word}`" in PAGE.read_text()


def test_every_route_is_listed() -> None:
    text = PAGE.read_text()
    rooms: list[Routes] = [room.routes for room in ROOMS]
    routes = [where for room in rooms for where in room.rules]
    assert len(routes) > 15
    for method, path in routes:
        short = path.removeprefix(PREFIX).removeprefix("/robots/{robot}")
        assert f"`{method} {short}`" in text or f"`{method} /robots/{{robot}}{short}`" in text, path
