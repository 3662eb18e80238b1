"""The limits that docs/security.md names are those of the code."""

from __future__ import annotations

import inspect
import re
from pathlib import Path

import pytest

from amberbox.fleet.asking import asking
from amberbox.fleet.asking.pool import Pool
from amberbox.fleet.feed import delta, feed
from amberbox.fleet.fetches import ledger
from amberbox.fleet.folders import folders
from amberbox.fleet.jobs.wanted import Downloads
from amberbox.link import limits

_POOL = inspect.signature(Pool).parameters
_DOWNLOADS = Downloads()
_MB, _GB = 1 << 20, 1 << 30

BOUNDS = {
    "questions that wait for a worker": f"{_POOL['most'].default}, {_POOL['each'].default} of one",
    "an answer": f"{asking.ANSWER_BYTES // _MB} MB in memory",
    "its worker": f"{asking.LIMIT_S:.0f} s and {asking.MEMORY_BYTES // _GB} GB of memory",
    "downloads": f"{_DOWNLOADS.each_waiting} that wait of one person, {_DOWNLOADS.each_gb:.0f} GB"
    f" each, {_DOWNLOADS.quota_gb:.0f} GB together, a day",
    "sockets of the feed": f"{feed.MOST}, {feed.MOST_EACH} of one person or token; changes held: "
    f"{delta.HELD:,} or {delta.HELD_BYTES // _MB} MB",
    "live values asked of one robot": f"{limits.VARIABLES:,} names",
    "folders of one robot": f"{folders.MOST}, {folders.MOST_BYTES // _MB} MB",
    "windows that wait for one robot": f"{ledger.MOST_OPEN}",
}


def rows(page: Path) -> dict[str, str]:
    """Return the table of bounds: what has one, and which."""
    _, _, text = page.read_text().partition("## What has an end")
    table = [line.strip("| ") for line in text.partition("\n## ")[0].splitlines() if "|" in line]
    return {what: bound for what, _, bound in (line.partition(" | ") for line in table)}


@pytest.mark.parametrize("what", BOUNDS)
def test_the_page_says_what_the_code_does(what: str) -> None:
    known = rows(Path(__file__).parents[2] / "docs" / "security.md")
    said = known.get(what) or next(bound for bound in known.values() if what in bound)
    assert re.search(rf"(?<![\d,]){re.escape(BOUNDS[what])}(?!\d)", said), said
