"""``amberbox verify``: its output and exit status."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from amberbox.blackbox.retention.maintenance import seal
from amberbox.blackbox.store.store import open_store
from amberbox.cli.main import main
from tests.support.manual_recorder import COUNT, ManualBox, number

pytest.importorskip("cryptography", reason="signatures need it; pip install 'amberbox[keep]'")


@pytest.fixture
def store(tmp_path: Path) -> Path:
    box = ManualBox(tmp_path / "store")
    for n in range(20):
        box.hear(COUNT, number(n))
        box.write()
    box.close()
    seal(open_store(box.store))
    return box.store


def journal(store: Path) -> Path:
    return next((store / "journal").glob("*.mcap"))


def test_an_intact_store_prints_what_to_note_down(
    store: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["verify", str(store), "--strict"]) == 0
    printed = capsys.readouterr()
    lines = printed.out.splitlines()
    assert lines[0].endswith(" intact")
    heads = {line.split()[1]: line.split()[2] for line in lines if line.startswith("head ")}
    assert {"manifest", "main", "key"} <= set(heads)
    assert "--key" in printed.err
    arguments = ["--head", heads["main"], "--head", heads["manifest"], "--key", heads["key"]]
    assert main(["verify", str(store), *arguments]) == 0
    assert "all before it is as it was" in capsys.readouterr().err


def test_damage_is_named_for_people_and_programs(
    store: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = journal(store)
    content = bytearray(path.read_bytes())
    content[len(content) // 3] ^= 4
    path.write_bytes(content)
    assert main(["verify", str(store)]) == 1
    first, second, *_ = capsys.readouterr().out.splitlines()
    assert first.startswith(f"damaged   journal/{path.name}: chunk does not match its checksum")
    assert "chunk at byte" in second and "2023-11-14T22:13" in second
    assert main(["verify", str(store), "--json"]) == 1
    document = json.loads(capsys.readouterr().out)
    (found,) = document["findings"]
    assert found["state"] == "damaged" and found["from"] <= found["to"]
    assert document["files"][f"journal/{path.name}"] == "damaged" and not document["good"]


def test_a_dropped_journal_ends_with_one(store: Path, capsys: pytest.CaptureFixture[str]) -> None:
    name = journal(store).name
    journal(store).unlink()
    assert main(["verify", str(store)]) == 1
    assert f"missing   journal/{name}: is gone" in capsys.readouterr().out


def test_an_unsigned_end_is_a_fault_only_when_asked(
    store: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    box = ManualBox(store)
    box.hear(COUNT, number(1))
    box.write()
    box.crash()
    assert main(["verify", str(store)]) == 0
    assert "ends unsigned at" in capsys.readouterr().out
    assert main(["verify", str(store), "--strict"]) == 1


def test_wrong_arguments_are_usage_errors(store: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["verify", str(store), "--head", "3f2a"]) == 2
    assert "no head in 3f2a" in capsys.readouterr().err
    assert main(["verify", str(store), "--key", "3f2a"]) == 2
    assert main(["verify", str(store / "nowhere")]) == 2
