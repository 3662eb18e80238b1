"""The page about data on the server names every route, form and state."""

from __future__ import annotations

from pathlib import Path
from typing import get_args

import pytest

from amberbox.core.api import DownloadFormat, DownloadState, FetchState, Integrity, RecordingState
from amberbox.server.api import data, missions, recordings
from amberbox.server.data.downloads import Downloads
from amberbox.server.data.query import Form
from amberbox.server.http.auth import PREFIX

PAGE = Path(__file__).parents[3] / "docs" / "server" / "data.md"
ROUTES = (
    recordings.download_routes, recordings.recording_routes, recordings.fetch_routes,
    missions.mission_routes,    missions.incident_routes, data.routes, data.query_routes,
)  # fmt: skip
WORDS = [
    *get_args(Form),
    *get_args(DownloadFormat),
    *get_args(Integrity),
    *get_args(RecordingState),
    *get_args(DownloadState),
    *get_args(FetchState),
    *Downloads.__dataclass_fields__,
]


@pytest.mark.parametrize("word", sorted(set(WORDS)))
def test_every_word_is_explained(word: str) -> None:
    assert f"`{word}`" in PAGE.read_text()


def test_every_route_is_listed() -> None:
    text = PAGE.read_text()
    routes = [where for one in ROUTES for where in one.rules]
    assert len(routes) > 15
    for method, path in routes:
        short = path.removeprefix(PREFIX).removeprefix("/robots/{robot}")
        assert f"`{method} {short}`" in text or f"`{method} /robots/{{robot}}{short}`" in text, path
