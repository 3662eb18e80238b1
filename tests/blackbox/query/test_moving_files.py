"""Questions to a store whose files go while it is read."""

from __future__ import annotations

from pathlib import Path

import pytest

import amberbox
from amberbox.blackbox.retention import missions
from amberbox.blackbox.store.catalogue import StoreCatalogue, query_catalogue
from amberbox.blackbox.store.journal_reader import journals
from amberbox.cli.main import main
from amberbox.core.clock import NS
from amberbox.core.errors import AmberboxError
from amberbox.testing.records import BATTERY, T0_NS, FakeRun, build_segments_of, fill_store


def ring_of(store: Path, files: int = 3) -> list[Path]:
    """Fill a ring of several files."""
    run = FakeRun(store, writer="ring")
    for number in range(files):
        start_ns = T0_NS + number * NS
        run.write([(start_ns + n, BATTERY, {"volts": float(n)}) for n in range(10)])
        if number < files - 1:
            run.rotate()
    run.close()
    return sorted((store / "ring").glob("*.mcap"))


def test_a_question_is_asked_again_when_a_file_is_gone(tmp_path: Path) -> None:
    fill_store(tmp_path)
    looks: list[StoreCatalogue] = []

    def question(catalogue: StoreCatalogue) -> int:
        looks.append(catalogue)
        if len(looks) < 3:
            raise FileNotFoundError
        return 7

    assert query_catalogue(tmp_path, question) == 7
    assert len({id(look) for look in looks}) == 3


def test_a_question_that_never_finds_its_files_is_an_error(tmp_path: Path) -> None:
    fill_store(tmp_path)

    def question(catalogue: StoreCatalogue) -> None:
        raise FileNotFoundError

    with pytest.raises(AmberboxError, match="changed while they were being read"):
        query_catalogue(tmp_path, question)


@pytest.mark.parametrize(("writer", "asked"), [("ring", 1), ("main", 2)])
def test_only_a_journal_that_may_have_become_a_segment_is_looked_for_again(
    tmp_path: Path, writer: str, asked: int
) -> None:
    fill_store(tmp_path)
    ring_of(tmp_path)
    counts = []

    def question(catalogue: StoreCatalogue) -> None:
        counts.append(len(catalogue.existing))
        name = next(j for j in journals(tmp_path) if j.writer == writer and j.finished)
        if len(counts) == 1:
            name.path.unlink()

    query_catalogue(tmp_path, question)
    assert len(counts) == asked


def test_missions_are_looked_for_again_when_a_file_is_gone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    fill_store(tmp_path)
    build_segments_of(tmp_path)
    looks: list[StoreCatalogue] = []
    look = missions._load

    def first_in_vain(catalogue: StoreCatalogue) -> list[missions.RecordedMission]:
        looks.append(catalogue)
        if len(looks) == 1:
            raise FileNotFoundError
        return look(catalogue)

    monkeypatch.setattr(missions, "_load", first_in_vain)
    assert missions.load(tmp_path) == []
    assert len(looks) == 2


def test_what_a_ring_forgot_is_told_as_such(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    fill_store(tmp_path)
    ring_of(tmp_path)[1].unlink()
    (gap,) = [g for g in amberbox.open(tmp_path).gaps() if g.writer == "ring"]
    assert (gap.reason, gap.count) == ("deleted: older than the ring", 10)
    assert main(["gaps", str(tmp_path)]) == 0
    row = next(line for line in capsys.readouterr().out.splitlines() if "older than" in line)
    assert "all of ring" in row


def test_what_incidents_hold_outlives_a_ring_in_memory(tmp_path: Path) -> None:
    fill_store(tmp_path)
    held = tmp_path / "incidents" / "2026-11-21-071006-2a7e" / "ring"
    held.mkdir(parents=True)
    first = ring_of(tmp_path)[0]
    before = len(amberbox.open(tmp_path).query("battery"))
    first.rename(held / first.name)
    memory = tmp_path / "ring"
    for file in memory.glob("*"):
        file.unlink()
    memory.rmdir()
    memory.symlink_to(tmp_path / "gone")
    assert len(amberbox.open(tmp_path).query("battery")) == before - 20
