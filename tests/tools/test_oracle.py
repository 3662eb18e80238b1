"""The oracle of behaviour: it sees a difference, replaces little, and mutants can be planted."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from tools.oracle.compare import differences, report
from tools.oracle.mutants import MUTANTS, Mutant, place_of, planted
from tools.oracle.normalise import FIELDS, normalised
from tools.oracle.side import FREEZE, NOW_NS

SOURCE = Path(__file__).parents[2] / "src" / "amberbox"


@pytest.mark.parametrize("mutant", MUTANTS, ids=lambda mutant: mutant.name)
def test_the_snippet_of_a_mutant_occurs_once(mutant: Mutant) -> None:
    assert place_of(mutant, SOURCE).is_file()
    assert mutant.snippet != mutant.replacement


def test_a_mutant_is_planted_and_taken_out_again(tmp_path: Path) -> None:
    file = tmp_path / "moved" / "anywhere.py"
    file.parent.mkdir()
    file.write_text("a = 1\n")
    mutant = Mutant("m", "a = 1", "a = 2", ("part",))
    with planted(mutant, tmp_path) as path:
        assert path.read_text() == "a = 2\n"
    assert file.read_text() == "a = 1\n"
    with pytest.raises(LookupError, match="0 times"):
        place_of(Mutant("n", "b = 1", "", ()), tmp_path)


def test_a_difference_is_found_and_shown(tmp_path: Path) -> None:
    base, new = tmp_path / "base", tmp_path / "new"
    for side, text in ((base, "one\ntwo\n"), (new, "one\n2\n")):
        (side / "part").mkdir(parents=True)
        (side / "part" / "same.txt").write_text("x")
        (side / "part" / "other.txt").write_text(text)
        (side / "part" / "file.bin").write_bytes(b"\xff\x00" + text.encode())
    (new / "part" / "more.txt").write_text("new")
    found = differences(base, new)
    assert found == ["part/file.bin", "part/more.txt", "part/other.txt"]
    shown = report(base, new, found)
    assert "-two" in shown and "+2" in shown
    assert "different from byte 6" in shown and "is not there on the side of base" in shown
    assert differences(base, base) == []


def test_every_normalised_field_is_there_for_a_reason() -> None:
    names = [field.name for field in FIELDS]
    assert len(set(names)) == len(names)
    assert all(field.why for field in FIELDS)
    text = "9684 rows in 1.1 s, 3.3 MB in out-csv\n"
    assert normalised("x", text) == "9684 rows in <seconds> s, 3.3 MB in out-csv\n"
    assert normalised("x", "level error since 1.1 s\n") == "level error since 1.1 s\n"


_ASK = """
import datetime, os, random, time, uuid
print(time.time_ns(), datetime.datetime.now(datetime.UTC), uuid.uuid4(), random.random())
print(os.urandom(4).hex(), time.strftime("%H:%M:%S"))
began = time.monotonic()
time.sleep(0.01)
assert time.monotonic() > began
"""


def test_time_and_chance_are_frozen() -> None:
    environment = {**os.environ, "PYTHONPATH": str(FREEZE), "ORACLE_SEED": "1", "TZ": "UTC",
                   "ORACLE_NOW_NS": str(NOW_NS), "ORACLE_START_NS": str(NOW_NS)}  # fmt: skip
    said = [
        subprocess.run([sys.executable, "-c", _ASK], env={**environment, "ORACLE_SEED": seed},
                       check=True, capture_output=True, text=True).stdout
        for seed in ("1", "1", "2")
    ]  # fmt: skip
    assert said[0] == said[1] != said[2]
    assert said[0].startswith(f"{NOW_NS} 2026-01-05 09:00:00+00:00 ")
    assert said[0].endswith(" 09:00:00\n")
