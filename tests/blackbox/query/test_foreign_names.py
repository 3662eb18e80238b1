"""Recordings of other tools may use any item names: files made from them stay in the store."""

from __future__ import annotations

from pathlib import Path

import pytest

import amberbox
from amberbox.blackbox.query.export import export
from amberbox.blackbox.query.export_job import View
from amberbox.blackbox.store.incident import incident_folder
from amberbox.blackbox.store.store import open_store
from amberbox.core.errors import AmberboxError
from amberbox.testing.records import T0_NS, FakeItem, FakeRun, build_segments_of

NAMES = ["../../pwned", "/tmp/pwned-by-a-file", "..", "a\0b", "a/c", "x" * 5000]


@pytest.fixture
def store(tmp_path: Path) -> Path:
    """A store whose journal names its items in ways that ours never does."""
    path = tmp_path / "a" / "b" / "store"
    path.parent.mkdir(parents=True)
    run = FakeRun(path, items=[FakeItem(name, [{"a": 1}]) for name in NAMES])
    run.write([(T0_NS + n, item, {"a": n}) for n, item in enumerate(run.items)])
    run.close()
    return path


@pytest.mark.parametrize("has_segments", [False, True])
def test_tables_of_all_kinds_of_names_stay_in_their_folder(
    store: Path, tmp_path: Path, has_segments: bool
) -> None:
    if has_segments:
        build_segments_of(store)
    target = tmp_path / "a" / "b" / "out"
    before = {path for path in tmp_path.rglob("*") if store not in path.parents}
    record = amberbox.open(store)
    export(record, View(), target, "csv")
    after = {path for path in tmp_path.rglob("*") if store not in path.parents}
    assert {path.parent for path in after - before - {target}} == {target}
    assert len(list(target.glob("*.csv"))) == len(NAMES)
    values = [record.query(info.name, ["a"]).values("a") for info in record.items()]
    assert sorted(values) == [[number] for number in range(len(NAMES))]
    (view,) = [info.name for info in record.items() if info.name.startswith("xxx")]
    assert record.sql(f"select a from {view}").values("a") == [5]


@pytest.mark.parametrize("name", ["../x", "/etc/passwd", "journal/../../x", "", "journal//x"])
def test_no_name_in_a_store_leads_out_of_it(store: Path, name: str) -> None:
    opened = open_store(store)
    for made in (opened.journal_path, lambda name: incident_folder(opened, name)):
        with pytest.raises(AmberboxError, match="is no name of a file below"):
            made(name)
