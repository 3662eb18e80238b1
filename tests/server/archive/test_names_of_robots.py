"""Any names of items in a journal, also in one of an older server: no file outside the archive."""

from __future__ import annotations

import re
from collections.abc import Callable
from functools import partial
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from amberbox.blackbox.columns.flat_tables import TableSchema
from amberbox.core.errors import AmberboxError
from amberbox.core.types import Column
from amberbox.server.archive.catalogue import RobotStore
from amberbox.server.archive.delta_files import ArchiveLayout, table_of
from amberbox.server.archive.folder import FolderArchive
from amberbox.server.journals import OWN, Retention
from amberbox.testing.records import T0_NS, FakeItem, FakeRun
from tests.fuzzing import examples, fuzz
from tests.server.archive.recordings import Robot

NAMES = ["../../pwned", "/tmp/pwned-by-a-robot", ".", "a/b/c", "a\0b", "x" * 300, "x" * 100_000]


def test_items_of_all_kinds_of_names_are_in_tables_and_nothing_is_elsewhere(
    archive: FolderArchive, tmp_path: Path
) -> None:
    """As if an older server had verified them."""
    for number, name in enumerate(["odom", *NAMES]):
        robot = Robot(f"r{number}", tmp_path)
        run = FakeRun(robot.store, items=[FakeItem(name, [{"a": 1}])])
        run.write([(T0_NS, run.items[0], {"a": number})])
        run.close()
        robot.hand_in_all(archive)
    before = _outside(tmp_path)
    assert archive.commit(0.0).journals == 1 + len(NAMES)
    archive.compact()
    archive.retain([Retention(keeping=OWN, columns_s=1.0)])
    archive.sweep()
    assert _outside(tmp_path) == before
    tables = {path.name for path in archive.layout.tables.iterdir() if path.is_dir()}
    assert all(re.fullmatch(r"[A-Za-z_]\w{0,199}", name) for name in tables), tables
    rows = [archive.robot().query(info.name, ["a"]) for info in archive.robot().items()]
    assert sorted(value for table in rows for value in table.values("a")) == [*range(8)]
    assert len(archive.robot().sql("select * from odom")) == 1


def _outside(folder: Path) -> set[str]:
    found = {str(path) for path in folder.parent.glob("*")}
    return found | {str(p) for p in folder.rglob("*") if (folder / "server") not in p.parents}


@fuzz
@settings(
    max_examples=examples(100), suppress_health_check=[HealthCheck.function_scoped_fixture]
)  # fmt: skip
@given(parts=st.lists(st.text("./\\~a\0-\n\u202e", max_size=5) | st.just(".."), max_size=4))
def test_no_name_makes_a_path_that_leads_out(tmp_path: Path, parts: list[str]) -> None:
    layout = ArchiveLayout(tmp_path)
    text = "/".join(parts)
    makers: list[Callable[[], Path]] = [
        partial(layout.table, text),
        partial(layout.table, f"{text}/0123456789abcdef"),
        partial(layout.table, f"odom/{text}"),
        partial(layout.journal, "r1", "s", text),
        partial(layout.journal, *[*parts, "", "", ""][:3]),
    ]
    for made in makers:
        try:
            path = made()
        except AmberboxError:
            continue
        assert path.resolve().is_relative_to(tmp_path.resolve())
        assert path.resolve() not in (tmp_path, layout.tables, layout.journals)


def test_tables_that_an_older_server_made_elsewhere_do_not_break_this_one(
    archive: FolderArchive, tmp_path: Path
) -> None:
    robot = Robot("r1", tmp_path)
    robot.record(0, files=1)
    robot.hand_in_all(archive)
    source = RobotStore("r1", robot.store_id)
    for item in ("../../pwned", "a\0b"):
        schema = TableSchema(item, "t", (Column("a", "a", "int64"),))
        archive.catalogue.register(schema, source)
        with pytest.raises(AmberboxError, match="no name of a table"):
            archive.layout.table(table_of(schema))
    assert archive.commit(0.0).journals == 1
    archive.compact()
    archive.retain([Retention(columns_s=1.0)])
    archive.sweep()
    assert {info.name for info in archive.robot().items()} >= {"odom", "battery"}
    assert len(archive.robot().sql("select * from odom")) == 40


def test_names_that_differ_in_case_are_views_of_their_own(
    archive: FolderArchive, tmp_path: Path
) -> None:
    """SQL ignores case; a robot must not break other robots' queries by such a name."""
    for number, name in enumerate(["Odom", "odom", "ODOM"]):
        robot = Robot(f"r{number}", tmp_path)
        run = FakeRun(robot.store, items=[FakeItem(name, [{"a": 1}])])
        run.write([(T0_NS, run.items[0], {"a": number})])
        run.close()
        robot.hand_in_all(archive)
    archive.commit(0.0)
    views = archive.robot().sql("show tables").values("name")
    assert len(views) == 3 == len({view.casefold() for view in views})
    counted = [archive.robot().sql(f"select a from {view}").values("a") for view in views]
    assert sorted(counted) == [[0], [1], [2]]
