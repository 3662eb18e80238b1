"""Rows over the API: formats, limits, waiting journals, gaps, statistics, and permissions."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterator
from typing import Any

import msgspec
import numpy as np
import pyarrow as pa
import pytest
from starlette.testclient import TestClient

from amberbox.core.timestamps import format_time
from amberbox.server.data.query import MAGIC
from amberbox.testing.records import T0_NS
from tests.server.data.filled import FORMULAS, ROWS, fill
from tests.server.house import House, house

ALL = ROWS + 40
QUERY = "/api/v1/robots/ropod_001/query"
_MS = 1_000_000


@pytest.fixture(scope="module")
def home(tmp_path_factory: pytest.TempPathFactory) -> Iterator[House]:
    folder = tmp_path_factory.mktemp("query")
    with house(folder / "server") as found:
        fill(found, folder)
        yield found


@pytest.fixture(scope="module")
def viewer(home: House) -> TestClient:
    return home.client("viewer")


def ask(client: TestClient, **parameters: Any) -> Any:
    return client.get(QUERY, params={"item": "odom", **parameters})


def at(number: int) -> str:
    return format_time(T0_NS + number * 10 * _MS)


def test_items_are_listed_with_what_waits(viewer: TestClient) -> None:
    listed = viewer.get("/api/v1/robots/ropod_001/items").json()
    pose = next(item for item in listed if item["name"] == "odom")
    assert pose["rows"] == ALL
    assert pose["first"] <= at(0)
    assert pose["rate_hz"] == pytest.approx(100, rel=0.2)
    assert [item["source"] == "amberbox" for item in listed] == sorted(
        item["source"] == "amberbox" for item in listed
    )


def test_an_item_has_columns(viewer: TestClient) -> None:
    found = viewer.get("/api/v1/robots/ropod_001/items/ODOM").json()
    assert found["name"] == "odom"
    assert {"name": "pose_x", "path": "pose/x", "type": "float64", "unit": "", "labels": {}} in (
        found["columns"]
    )
    assert viewer.get("/api/v1/robots/ropod_001/items/pos").status_code == 404
    assert viewer.get("/api/v1/robots/ropod_002/items").json() == []


def test_rows_are_those_of_columns_and_of_journals_that_wait(viewer: TestClient) -> None:
    found = ask(viewer, variables="received,pose_x").json()
    assert found["rows"] == ALL
    assert [row[1:] for row in found["data"]] == [[at(n), n] for n in range(ALL)]
    assert found["complete_to"] >= at(ALL - 1)
    assert found["kind"] == "rows"
    assert found["next"] is None


def test_a_range_holds_what_lies_in_it(viewer: TestClient) -> None:
    found = ask(viewer, variables="received", **{"from": at(30), "to": at(50)}).json()
    assert [row[1] for row in found["data"]] == [at(n) for n in range(30, 50)]
    late = ask(viewer, variables="pose_x", **{"from": at(ROWS - 5), "to": at(ROWS + 5)}).json()
    assert [row[1] for row in late["data"]] == list(range(ROWS - 5, ROWS + 5))


def test_more_rows_come_with_the_next_question(viewer: TestClient) -> None:
    seen: list[str] = []
    start = ""
    while start is not None:
        found = ask(viewer, limit=33, variables="received", **{"from": start}).json()
        assert len(found["data"]) <= 33
        seen += [row[1] for row in found["data"]]
        start = found["next"]
    assert seen == [at(n) for n in range(ALL)]


def test_points_keep_the_extremes(viewer: TestClient) -> None:
    everything = [row[1] for row in ask(viewer, variables="pose_x").json()["data"]]
    found = ask(viewer, variables="pose_x", points=20).json()
    values = [row[1] for row in found["data"]]
    assert len(values) <= 20
    assert (min(values), max(values)) == (min(everything), max(everything))


def test_csv_has_times_and_no_formulas(viewer: TestClient) -> None:
    found = ask(viewer, format="csv", variables="pose_x")
    assert found.headers["content-type"].startswith("text/csv")
    assert 'filename="ropod_001-odom.csv"' in found.headers["content-disposition"]
    lines = list(csv.reader(io.StringIO(found.text)))
    assert lines[0] == ["timestamp", "pose_x"]
    assert lines[1][1] == "0.0"
    assert len(lines) == ALL + 1


def test_a_formula_becomes_text(viewer: TestClient) -> None:
    found = viewer.get(QUERY, params={"item": "note", "format": "csv"})
    cells = [row[1] for row in csv.reader(io.StringIO(found.text))]
    assert cells == ["text", *(f"'{text}" for text in FORMULAS), "plain"]


def test_arrow_has_types_and_units(viewer: TestClient) -> None:
    found = ask(viewer, format="arrow", variables="pose_x")
    table = pa.ipc.open_stream(found.content).read_all()
    assert table.num_rows == ALL
    assert table.schema.field("timestamp").type == pa.timestamp("ns", "UTC")
    assert table.schema.field("pose_x").metadata[b"path"] == b"pose/x"
    assert found.headers["x-amberbox-rows"] == str(ALL)


def test_a_plot_is_plain_numbers(viewer: TestClient) -> None:
    content = ask(viewer, format="plot", variables="pose_x").content
    assert content[:4] == MAGIC
    length = int.from_bytes(content[4:8], "little")
    head = msgspec.json.decode(content[8 : 8 + length])
    numbers = np.frombuffer(content[8 + length :], "<f8").reshape(2, head["rows"])
    rows = ask(viewer, variables="pose_x").json()["data"]
    assert length % 8 == 0
    assert head["t0"] == at(0)
    assert [column["name"] for column in head["columns"]] == ["pose_x"]
    assert numbers[0] == pytest.approx(np.arange(ALL) / 100)
    assert numbers[1].tolist() == [row[1] for row in rows]


@pytest.mark.parametrize(
    ("parameters", "status", "what"),
    [
        ({"item": "pos"}, 400, "no data item"),
        ({"variables": "pose_q"}, 400, "no variable"),
        ({"from": "soon"}, 400, "not a time"),
        ({"from": "now", "to": "now-1h"}, 400, "ends before it begins"),
        ({"format": "xlsx"}, 422, "format"),
        ({"limit": "0"}, 422, "limit"),
        ({"item": "../../etc/passwd"}, 422, "item"),
    ],
)
def test_what_is_wrong_is_said(
    viewer: TestClient, parameters: dict[str, str], status: int, what: str
) -> None:
    found = ask(viewer, **parameters)
    assert found.status_code == status
    assert what in found.json()["error"]["what"]


def test_sums_are_those_of_the_rows(viewer: TestClient) -> None:
    values = [row[1] for row in ask(viewer, variables="pose_x").json()["data"]]
    found = viewer.get(
        "/api/v1/robots/ropod_001/statistics", params={"item": "odom", "variables": "pose_x"}
    ).json()
    (one,) = found["variables"]
    assert found["exact"]
    assert (one["count"], one["min"], one["max"]) == (ALL, min(values), max(values))
    assert one["mean"] == pytest.approx(np.mean(values))


def test_gaps_are_what_no_question_is_answered_from(home: House, viewer: TestClient) -> None:
    found = viewer.get("/api/v1/robots/ropod_001/gaps").json()
    (waiting, *_) = home.services.archive.catalogue.waiting()
    assert not found["gaps"] and not found["more"]
    assert ask(viewer, **{"from": str(waiting.start_ns)}).json()["data"]


def test_a_robot_of_another_group_is_not_there(home: House) -> None:
    nurse = home.client("nurse")
    assert ask(nurse).status_code == 200
    for path in ("query?item=odom", "items", "items/odom", "gaps", "statistics?item=odom"):
        assert nurse.get(f"/api/v1/robots/ropod_003/{path}").status_code == 404
    assert home.robot_client().get(f"{QUERY}?item=odom").status_code == 404
    assert home.client().get(f"{QUERY}?item=odom").status_code == 401
    assert home.token_client("viewer", "read:status").get(QUERY).status_code == 403
