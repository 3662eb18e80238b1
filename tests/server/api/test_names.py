"""Names that the API shows: each form and answer has one, and ends of time are called alike."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from typing import Any

import pytest

from tests.server.house import house

OTHERS = {"start", "end", "begin", "stop"}
"""What ends of a stretch of time are not called: they are ``from`` and ``to``."""
DEADLINES = {"Said", "Shelving"}
"""These have an ``until``: something lasts from now on."""
MOMENTS = {"MomentNote", "NewMomentNote"}
"""These are about a moment, ``at``, and may go on ``to`` a later one."""
OPEN = {"NewFollowing"}
"""These go on ``from`` a time until somebody ends them."""


@pytest.fixture(scope="module")
def openapi(tmp_path_factory: pytest.TempPathFactory) -> Mapping[str, Any]:
    with house(tmp_path_factory.mktemp("house"), shared=True) as home:
        return dict(home.app.openapi())


def fields(openapi: Mapping[str, Any]) -> Iterator[tuple[str, set[str]]]:
    """Yield the names of fields of each schema, and of parameters of each operation."""
    for name, schema in openapi["components"]["schemas"].items():
        yield name, set(schema.get("properties", ()))
    for path, methods in openapi["paths"].items():
        for method, said in methods.items():
            yield f"{method} {path}", {one["name"] for one in said.get("parameters", ())}


def test_no_two_schemas_share_a_name(openapi: Mapping[str, Any]) -> None:
    names = list(openapi["components"]["schemas"])
    assert len(names) > 60
    shared = [name for name in names if not re.fullmatch(r"[A-Z][A-Za-z]+", name)]
    assert not shared, "of schemas of one name OpenAPI says the module, or -Input and -Output"


def test_a_stretch_of_time_has_from_and_to(openapi: Mapping[str, Any]) -> None:
    known = dict(fields(openapi))
    for where, names in known.items():
        assert not names & OTHERS, where
        begins = names & {"from", "at"} if where in MOMENTS else names & {"from"}
        assert bool(begins) == ("to" in names) or where in OPEN, where
        assert "until" not in names or where in DEADLINES, where
    assert {"Stretch", "Timeline", "Window", "Consequence", "AlarmRobot", "Mission"} <= {
        where for where, names in known.items() if "from" in names
    }
