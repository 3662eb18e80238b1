"""items, query, plot and sql on the command line: formats, ranges, errors, closed pipes."""

from __future__ import annotations

import csv
import io
import json
import os
import subprocess
import sys
from functools import partial
from pathlib import Path
from typing import Any

import pytest

import amberbox
from amberbox.cli.main import main
from amberbox.core.errors import UsageError
from amberbox.testing.clock import PATIENCE_S
from amberbox.testing.records import T0_NS, FakeRun, build_segments_of, fill_store
from tests.cli.conftest import Terminal


@pytest.fixture
def store(tmp_path: Path) -> str:
    path = tmp_path / "store"
    fill_store(path)
    build_segments_of(path, 1)
    return str(path)


def rows_of(text: str) -> list[dict[str, str]]:
    return list(csv.DictReader(io.StringIO(text)))


def test_items_for_programs(store: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["items", store, "--json"]) == 0
    found = {item["name"]: item for item in json.loads(capsys.readouterr().out)}
    assert found["odom"] | {"bytes": 0} == {
        "name": "odom",
        "source": "test",
        "topic": "/odom",
        "type": "odom",
        "rows": 300,
        "first": "2026-09-21T14:13:20.000000000Z",
        "last": "2026-09-21T14:13:22.990000000Z",
        "rate_hz": 100.0,
        "stamp_offset_s": 0.003,
        "bytes": 0,
    }


def test_items_for_people(store: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["items", store]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].split()[:3] == ["item", "type", "rows"]
    assert lines[2].split()[:3] == ["battery", "battery", "30"]


def test_an_empty_record_is_no_error(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    FakeRun(tmp_path).close()
    assert main(["items", str(tmp_path)]) == 0
    assert "nothing has been recorded" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("options", "numbers"),
    [
        (["--from", "-100ms"], range(289, 300)),
        (["--from=-100ms", "--to", "now"], range(289, 300)),
        (["--to", "2026-09-21T14:13:20.05Z"], range(5)),
        (["--from", str(T0_NS), "--to", str(T0_NS + 20_000_000)], range(2)),
        (["--by", "timestamp", "--to", "2026-09-21T14:13:20.05Z"], range(6)),
    ],
)
def test_ranges(
    store: str, capsys: pytest.CaptureFixture[str], options: list[str], numbers: range
) -> None:
    assert main(["query", store, "odom", "pose/x", "--format", "csv", *options]) == 0
    found = [float(row["pose_x"]) for row in rows_of(capsys.readouterr().out)]
    assert found == [float(number) for number in numbers]


def test_every_format_says_the_same(
    store: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    import pyarrow.parquet as pq

    ask = ["query", store, "odom", "x", "mode", "--points", "50"]
    assert main([*ask, "--format", "csv"]) == 0
    table = rows_of(capsys.readouterr().out)
    assert len(table) <= 50
    assert main([*ask, "--format", "json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert [(str(row["pose_x"]), row["mode"]) for row in found] == [
        (row["pose_x"], row["mode"]) for row in table
    ]
    assert main([*ask]) == 0
    assert len(capsys.readouterr().out.splitlines()) == len(table) + 2
    for name in ("out.csv", "out.json", "out.parquet"):
        assert main([*ask, "-o", str(tmp_path / name)]) == 0
    assert rows_of((tmp_path / "out.csv").read_text()) == table
    assert json.loads((tmp_path / "out.json").read_text()) == found
    assert pq.read_table(tmp_path / "out.parquet").num_rows == len(table)


@pytest.mark.parametrize(
    ("arguments", "what"),
    [
        (["odmo"], "did you mean odom?"),
        (["odom", "pose/z"], "did you mean pose/"),
        (["odom", "--from", "yesterday"], "not a time: 'yesterday'"),
        (["odom", "--format", "parquet"], "add -o"),
        (["odom", "--points", "0"], "points must be 1 or more"),
        (["odom", "--follow", "--points", "3"], "leave out"),
        (["odom", "--follow", "--by", "timestamp"], "leave out --by"),
        (["odom", "-o", "nowhere/x.csv"], "no folder nowhere"),
    ],
)
def test_wrong_usage_is_told_in_two_lines(
    store: str, capsys: pytest.CaptureFixture[str], arguments: list[str], what: str
) -> None:
    assert main(["query", store, *arguments]) == 2
    printed = capsys.readouterr()
    assert printed.out == ""
    assert what in printed.err
    assert "Traceback" not in printed.err


def test_an_empty_range_says_where_the_rows_are(
    store: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["query", store, "odom", "--to", "1", "--format", "json"]) == 0
    printed = capsys.readouterr()
    assert json.loads(printed.out) == []
    assert "odom has 300 from 2026-09-21T14:13:20" in printed.err


def test_follow_prints_rows_until_it_is_stopped(store: str) -> None:
    command = [sys.executable, "-m", "amberbox.cli.main", "query", store, "odom", "x", "--follow",
               "--from", "-50ms", "--format", "json"]  # fmt: skip
    code = "import sys; from amberbox.cli.main import main; sys.exit(main(sys.argv[1:]))"
    command = [sys.executable, "-c", code, *command[3:]]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE) as process:
        assert process.stdout is not None
        lines = [process.stdout.readline() for _ in range(6)]
        process.stdout.close()  # as ``| head`` does
        process.terminate()
        _, errors = process.communicate(timeout=PATIENCE_S)
    assert [json.loads(line)["pose_x"] for line in lines] == [294.0 + n for n in range(6)]
    assert b"Traceback" not in errors


def test_a_closed_pipe_is_quiet(store: str) -> None:
    reading, writing = os.pipe()
    os.close(reading)
    code = "import sys; from amberbox.cli.main import main; sys.exit(main(sys.argv[1:]))"
    command = [sys.executable, "-c", code, "query", store, "odom"]
    done = subprocess.run(
        command, stdout=writing, stderr=subprocess.PIPE, timeout=PATIENCE_S, check=False
    )
    os.close(writing)
    assert done.stderr == b""


@pytest.mark.parametrize("kind", ["png", "svg", "pdf", "html"])
def test_plot(store: str, tmp_path: Path, kind: str, capsys: pytest.CaptureFixture[str]) -> None:
    target = tmp_path / f"out.{kind}"
    assert main(["plot", store, "odom", "x", "y", "-o", str(target), "--points", "100"]) == 0
    head = {"png": b"\x89PNG", "svg": b"<?xml", "pdf": b"%PDF", "html": b"<!DOCTYPE html>"}
    assert target.read_bytes().startswith(head[kind])
    assert "300 rows" in capsys.readouterr().out


def plot_data(path: Path) -> dict[str, Any]:
    text = path.read_text()
    start = text.index("const data = ") + len("const data = ")
    data: dict[str, Any] = json.loads(text[start : text.index(";\n", start)])
    return data


def test_the_page_is_complete_and_asks_nobody(store: str, tmp_path: Path) -> None:
    target = tmp_path / "out.html"
    assert main(["plot", store, "odom", "x", "-o", str(target)]) == 0
    text = target.read_text()
    assert "{{" not in text
    assert "http" not in text
    assert "src=" not in text
    data = plot_data(target)
    assert data["t0"] == "2026-09-21T14:13:20.000000000Z"
    assert data["clock"] == "time of receipt"


def test_a_gap_breaks_the_line_and_is_shaded(tmp_path: Path) -> None:
    from amberbox.testing.records import BATTERY

    second = 1_000_000_000
    run = FakeRun(tmp_path)
    run.write(
        [(T0_NS + n * second, BATTERY, {"volts": 1.0 * n}) for n in (*range(5), *range(60, 65))]
    )
    gap = {"item": "battery", "peer": "p", "from_ns": T0_NS + 5 * second,
           "to_ns": T0_NS + 60 * second, "reason": "publisher died", "count": None}  # fmt: skip
    run.own("amberbox/gap", T0_NS + 60 * second, gap)
    run.close()
    target = tmp_path / "out.html"
    assert main(["plot", str(tmp_path), "battery", "volts", "-o", str(target)]) == 0
    data = plot_data(target)
    assert data["gaps"] == [[5.0, 60.0, "publisher died"]]
    (panel,) = data["panels"]
    assert panel["curves"][0]["y"] == [0.0, 1.0, 2.0, 3.0, 4.0, None, 60.0, 61.0, 62.0, 63.0, 64.0]


@pytest.mark.parametrize(
    ("arguments", "what", "status"),
    [
        (["odom", "mode", "-o", "x.html"], "mode is string, not a number", 2),
        (["odom", "ranges", "-o", "x.html"], "name an element: ranges[0]", 2),
        (["odom", "x", "-o", "x.gif"], "html, png, svg or pdf", 2),
        (["odom", "x", "--to", "1", "-o", "x.html"], "no rows in this range", 1),
    ],
)
def test_what_cannot_be_plotted(
    store: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    arguments: list[str],
    what: str,
    status: int,
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(["plot", store, *arguments]) == status
    assert what in capsys.readouterr().err


def test_plot_without_matplotlib_names_the_way_out(
    store: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setitem(sys.modules, "matplotlib.figure", None)
    assert main(["plot", store, "odom", "x", "-o", str(tmp_path / "a.png")]) == 2
    assert "or write an html file" in capsys.readouterr().err


def test_sql_prints_what_is_asked(store: str, capsys: pytest.CaptureFixture[str]) -> None:
    statement = "select mode, count(*) as n, sum(pose_x) as s from odom group by mode order by mode"
    assert main(["sql", store, statement, "--format", "json"]) == 0
    assert json.loads(capsys.readouterr().out) == [
        {"mode": "A", "n": 150, "s": 22350.0},
        {"mode": "B", "n": 150, "s": 22500.0},
    ]


@pytest.mark.parametrize("verb", ["query", "sql", "items"])
def test_tables_fit_a_terminal(
    store: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], verb: str
) -> None:
    ask = {"query": ["odom"], "sql": ["select * from odom"], "items": ["--all"]}[verb]
    assert main([verb, store, *ask]) == 0
    piped = capsys.readouterr().out.splitlines()
    assert max(map(len, piped)) > 60 and "columns;" not in piped[-1]
    terminal = Terminal()
    monkeypatch.setattr("sys.stdout", terminal)
    monkeypatch.setenv("COLUMNS", "60")
    assert main([verb, store, *ask]) == 0
    shown = terminal.getvalue().splitlines()
    assert max(map(len, shown)) <= 60 and len(shown) == len(piped) + 1
    assert shown[0].split()[0] == piped[0].split()[0] and "..." in shown[2]
    assert " columns; " in shown[-1]


@pytest.mark.parametrize("ask", [["query", "odom"], ["sql", "select * from odom"]])
def test_json_by_its_short_name(
    store: str, ask: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    verb, what = ask
    assert main([verb, store, what, "--format", "json"]) == 0
    expected = json.loads(capsys.readouterr().out)
    assert main([verb, store, what, "--json"]) == 0
    assert json.loads(capsys.readouterr().out) == expected and len(expected) == 300
    assert main([verb, store, what, "--json", "--format", "csv"]) == 2
    assert "not allowed with" in capsys.readouterr().err


@pytest.mark.parametrize(
    "words",
    [
        ["query", "odom"], ["events"], ["gaps"], ["plot", "odom", "pose/x", "-o", "x.png"],
        ["export", "-o", "x.csv"], ["mission list"], ["foxglove"],
    ],
)  # fmt: skip
def test_a_range_that_ends_before_it_begins_is_refused(
    store: str, capsys: pytest.CaptureFixture[str], words: list[str]
) -> None:
    verb, *rest = words
    line = [*verb.split(), store, *rest]
    assert main([*line, "--from", "-1s", "--to=-2s"]) == 2
    error = capsys.readouterr().err
    assert "the range ends before it begins: from 2026-09-21T14:13:21" in error
    assert "hint: exchange from and to" in error
    assert main([*line, "--to", "yesterday"]) == 2
    assert "error: --to: not a time: 'yesterday'" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("line", "option"),
    [
        ("diagnose URL --at noon", "--at"), ("faulttree URL --closest --at noon", "--at"),
        ("rules --where URL --ask broken(X) --from noon", "--from"),
    ],
)  # fmt: skip
def test_a_time_for_a_server_names_its_option(
    line: str, option: str, capsys: pytest.CaptureFixture[str]
) -> None:
    """It is read here first: nothing is asked of the server."""
    assert main(line.replace("URL", "https://fleet.invalid/robots/r1").split()) == 2
    assert f"error: {option}: not a time: 'noon'" in capsys.readouterr().err


def test_a_range_from_python_that_ends_before_it_begins_is_refused(store: str) -> None:
    with amberbox.open(store) as record:
        for ask in (partial(record.query, "odom", None), record.gaps, record.events):
            with pytest.raises(UsageError, match="ends before it begins"):
                ask(from_=T0_NS + 1, to=T0_NS)
