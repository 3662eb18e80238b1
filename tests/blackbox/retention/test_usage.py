"""Disk use: every file and every inode counts once, however the store changes between checks."""

from __future__ import annotations

import os
from pathlib import Path

from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from amberbox.blackbox.retention.usage import DiskUse

NAMES = ["journal/1.mcap", "journal/2.mcap", "segments/a/1.parquet", "segments/a/.1.parquet.tmp",
         "manifest", "incidents/x/ring/1.mcap", "journal/head"]  # fmt: skip


def counted(root: Path) -> int:
    """Count the slow way."""
    found = {}
    for path in root.rglob("*"):
        if path.is_file() and not path.is_symlink():
            status = path.stat()
            found[status.st_ino] = max(status.st_size, status.st_blocks * 512)
    return sum(found.values())


@settings(max_examples=40, suppress_health_check=[
    HealthCheck.function_scoped_fixture])  # fmt: skip
@given(st.data())
def test_the_sum_is_right_after_any_change(tmp_path: Path, data: st.DataObject) -> None:
    root = tmp_path / str(len(list(tmp_path.iterdir())))
    root.mkdir()
    use = DiskUse(root)
    for _ in range(data.draw(st.integers(1, 8))):
        path = root / data.draw(st.sampled_from(NAMES))
        change = data.draw(st.sampled_from(["write", "delete", "link"]))
        path.parent.mkdir(parents=True, exist_ok=True)
        if change == "delete":
            path.unlink(missing_ok=True)
        elif change == "write" and not (path.exists() and path.suffix == ".parquet"):
            path.write_bytes(bytes(data.draw(st.integers(0, 20_000))))
        elif change == "link" and path.exists():
            target = root / f"incidents/y/{path.name}"
            target.parent.mkdir(parents=True, exist_ok=True)
            target.unlink(missing_ok=True)
            os.link(path, target)
        assert use.measure() == counted(root)


def test_a_growing_file_and_the_newest_journal_are_looked_at_each_time(tmp_path: Path) -> None:
    folder = tmp_path / "journal"
    folder.mkdir()
    for number in range(3):
        (folder / f"{number}.mcap").write_bytes(bytes(5000))
    os.utime(folder, ns=(1, 1))  # long ago: what is settled is not looked at again
    use = DiskUse(tmp_path)
    before = use.measure()
    with (folder / "2.mcap").open("ab") as file:
        file.write(bytes(100_000))
    assert use.measure() - before >= 95_000
    assert set(use.sizes("journal")) == {"0.mcap", "1.mcap", "2.mcap"}


def test_what_lies_elsewhere_is_not_counted(tmp_path: Path) -> None:
    elsewhere, store = tmp_path / "ram", tmp_path / "store"
    elsewhere.mkdir()
    store.mkdir()
    (elsewhere / "1.mcap").write_bytes(bytes(50_000))
    (store / "ring").symlink_to(elsewhere)
    assert DiskUse(store).measure() < 5000
