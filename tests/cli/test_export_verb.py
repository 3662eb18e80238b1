"""``amberbox export``: targets, formats, choice, report, exit status."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import pytest

import amberbox
from amberbox.blackbox.store.journal_reader import journals
from amberbox.cli.main import main
from amberbox.testing.records import build_segments_of, fill_store

Capture = pytest.CaptureFixture[str]


@pytest.fixture
def store(tmp_path: Path) -> Path:
    fill_store(tmp_path / "store")
    return tmp_path / "store"


def test_the_ending_says_the_format(store: Path, tmp_path: Path, capsys: Capture) -> None:
    for name in ("out.csv", "out.parquet", "out.mcap"):
        assert main(["export", str(store), "-o", str(tmp_path / name), "--item", "odom"]) == 0
        lines = capsys.readouterr().out.splitlines()
        assert lines[0] == "  odom: 300"
        what = "messages" if name == "out.mcap" else "rows"
        assert lines[-1].startswith(f"300 {what} in ") and lines[-1].endswith(str(tmp_path / name))
    assert main(["export", str(store), "-o", str(tmp_path / "out")]) == 2
    assert "does not say its format" in capsys.readouterr().err


def test_a_folder_of_tables(store: Path, tmp_path: Path, capsys: Capture) -> None:
    assert main(["export", str(store), "-o", str(tmp_path / "out"), "--format", "csv"]) == 0
    names = sorted(path.name for path in (tmp_path / "out").iterdir())
    assert names == ["battery.csv", "odom.csv", "odom__units.csv"]
    assert main(["export", str(store), "-o", str(tmp_path / "out"), "--format", "csv"]) == 2
    assert "is there already" in capsys.readouterr().err


@pytest.mark.parametrize("output", [[], ["-o", "-"]])
def test_rows_to_stdout(store: Path, capsys: Capture, output: list[str]) -> None:
    chosen = ["--variable", "odom.x", "--variable", "odom.mode", "--from", "-15ms"]
    assert main(["export", str(store), *output, *chosen]) == 0
    printed = capsys.readouterr()
    assert printed.out.splitlines() == [
        "timestamp,pose_x,mode",
        "2026-09-21T14:13:22.977000000Z,298.0,A",
        "2026-09-21T14:13:22.987000000Z,299.0,B",
    ]
    assert printed.err.startswith("2 rows in ")


def test_the_choice(store: Path, tmp_path: Path) -> None:
    target = tmp_path / "out.csv"
    chosen = ["--item", "battery", "--received", "--to", "2026-09-21T14:13:20.2Z"]
    assert main(["export", str(store), "-o", str(target), *chosen]) == 0
    expected = amberbox.open(store).query(
        "battery", ["volts", "received", "seq"], to="2026-09-21T14:13:20.2Z"
    )
    expected.to_csv(tmp_path / "expected.csv")
    assert target.read_text() == (tmp_path / "expected.csv").read_text()
    assert main(["export", str(store), "-o", str(target), "--item", "odom__units"]) == 0
    assert target.read_text().startswith("timestamp,parent_seq,index,id\n")


def test_the_report_for_programs(store: Path, tmp_path: Path, capsys: Capture) -> None:
    build_segments_of(store)
    journals(store)[0].path.unlink()
    target = tmp_path / "out.mcap"
    assert main(["export", str(store), "-o", str(target), "--json"]) == 1
    report = json.loads(capsys.readouterr().out)
    assert (report["format"], report["total"], report["counts"]) == (
        "mcap", 220, {"battery": 20, "odom": 200},
    )  # fmt: skip
    assert report["bytes"] == target.stat().st_size
    assert "are deleted; their columns (100 rows) are left" in report["missing"][1]
    assert main(["export", str(store), "-o", str(target)]) == 1
    assert "  missing: odom: original messages from" in capsys.readouterr().out


def test_wrong_usage(store: Path, tmp_path: Path, capsys: Capture) -> None:
    for arguments, text in (
        (["--variable", "odon.x", "-o", str(tmp_path / "x.csv")], "did you mean odom"),
        (["--variable", "odom.z", "-o", str(tmp_path / "x.csv")], "odom has no variable 'z'"),
        (["--item", "odom", "--format", "parquet"], "parquet needs a file"),
        (["--format", "bag"], "bag needs a file"),
        (["--json", "--item", "odom"], "would both go to stdout"),
        (["-o", str(tmp_path / "no" / "x.csv")], "there is no folder"),
        (["-o", str(tmp_path / "x.csv"), "--from", "10", "--to", "5"], "ends before it begins"),
    ):
        assert main(["export", str(store), *arguments]) == 2
        assert text in capsys.readouterr().err


def test_a_bar_shows_progress_on_a_terminal(
    store: Path, tmp_path: Path, capsys: Capture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True)
    for name, form in (("a.mcap", "mcap"), ("b.mcap", "mcap-json"), ("c", "csv")):
        assert main(["export", str(store), "-o", str(tmp_path / name), "--format", form]) == 0
        assert capsys.readouterr().err.endswith("[##############################] 100%\n")


def test_a_recording_file_is_exported_like_a_store(
    store: Path, tmp_path: Path, capsys: Capture
) -> None:
    assert main(["export", str(store), "-o", str(tmp_path / "a.mcap")]) == 0
    arguments = ["-o", str(tmp_path / "b.csv"), "--item", "test_odom"]
    assert main(["export", str(tmp_path / "a.mcap"), *arguments]) == 0
    assert (tmp_path / "b.csv").read_text().count("\n") == 301
