"""The limits that docs/server/security.md names are those of the code."""

from __future__ import annotations

import inspect
import re
from pathlib import Path

import pytest

from amberbox.link import limits
from amberbox.server.data.downloads import Downloads
from amberbox.server.ingest import fetches, folders
from amberbox.server.live import feed, listener
from amberbox.server.workers import pool
from amberbox.server.workers.pool import WorkerPool

_POOL = inspect.signature(WorkerPool).parameters
_DOWNLOADS = Downloads()
_MB, _GB = 1 << 20, 1 << 30

BOUNDS = {
    "questions that wait for a worker": f"{_POOL['most'].default}, {_POOL['each'].default} of one",
    "an answer": f"{pool.ANSWER_BYTES // _MB} MB in memory",
    "its worker": f"{pool.LIMIT_S:.0f} s and {pool.MEMORY_BYTES // _GB} GB of memory",
    "downloads": f"{_DOWNLOADS.each_waiting} that wait of one person, {_DOWNLOADS.each_gb:.0f} GB"
    f" each, {_DOWNLOADS.quota_gb:.0f} GB together, a day",
    "sockets of the feed": f"{feed.MOST}, {feed.MOST_EACH} of one person or token; changes held: "
    f"{listener.HELD:,} or {listener.HELD_BYTES // _MB} MB",
    "live values asked of one robot": f"{limits.VARIABLES:,} names",
    "folders of one robot": f"{folders.MOST}, {folders.MOST_BYTES // _MB} MB",
    "windows that wait for one robot": f"{fetches.MOST_OPEN}",
}


def rows(page: Path) -> dict[str, str]:
    """Return the bounds in the table, by resource."""
    _, _, text = page.read_text().partition("## What has an end")
    table = [line.strip("| ") for line in text.partition("\n## ")[0].splitlines() if "|" in line]
    return {what: bound for what, _, bound in (line.partition(" | ") for line in table)}


@pytest.mark.parametrize("what", BOUNDS)
def test_the_page_says_what_the_code_does(what: str) -> None:
    known = rows(Path(__file__).parents[2] / "docs" / "server" / "security.md")
    said = known.get(what) or next(bound for bound in known.values() if what in bound)
    assert re.search(rf"(?<![\d,]){re.escape(BOUNDS[what])}(?!\d)", said), said
