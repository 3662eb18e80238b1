"""Folders over HTTP: a robot hands in its own, technicians read it, nothing of it runs."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import msgspec
import pytest
import zstandard

from amberbox.link.folders import TAKEN_BYTES, address, pack
from amberbox.server.schema import AUDIT
from tests.server.house import House, house

HASH = "5ea1" * 16
FILES = {"robot.yaml": b"id: ropod_001\n", "components/laser.yaml": b"component_name: laser\n"}


@pytest.fixture(scope="module")
def home(tmp_path_factory: pytest.TempPathFactory) -> Iterator[House]:
    with house(tmp_path_factory.mktemp("house")) as found:
        assert found.robot_client().put(address(HASH), content=pack(FILES)).status_code == 204
        yield found


def _evil(files: dict[str, bytes]) -> bytes:
    return zstandard.ZstdCompressor().compress(msgspec.msgpack.encode(files))


def _standing(home: House) -> set[str]:
    root = home.services.folder / "folders"
    return {path.relative_to(root).as_posix() for path in root.rglob("*") if path.is_file()}


def test_what_a_robot_hands_in_is_listed_and_read(home: House) -> None:
    technician = home.client("technician")
    (listed,) = technician.get("/api/v1/robots/ropod_001/folder").json()["folders"]
    assert (listed["config_hash"], listed["files"], listed["masked"]) == (HASH, 2, 0)
    files = technician.get(f"/api/v1/robots/ropod_001/folder/{HASH}").json()["files"]
    assert [file["name"] for file in files] == ["components/laser.yaml", "robot.yaml"]
    read = technician.get(f"/api/v1/robots/ropod_001/folder/{HASH}/components/laser.yaml")
    assert read.content == FILES["components/laser.yaml"]
    assert read.headers["content-type"].startswith("text/plain")


def test_reading_a_file_is_in_the_audit_log(home: House) -> None:
    technician = home.client("technician")
    technician.get(f"/api/v1/robots/ropod_001/folder/{HASH}/robot.yaml")
    with home.services.database.reading() as connection:
        actions = [row.action for row in connection.execute(AUDIT.select())]
    assert "folder.read" in actions


def test_it_is_for_technicians_of_its_group(home: House) -> None:
    path = f"/api/v1/robots/ropod_001/folder/{HASH}/robot.yaml"
    assert home.client("operator").get(path).status_code == 403
    assert home.client("nurse").get(path).status_code == 200
    assert home.client("nurse").get(path.replace("_001", "_003")).status_code == 404


def test_a_folder_that_is_known_never_changes(home: House) -> None:
    other = pack({"robot.yaml": b"id: other\n"})
    assert home.robot_client().put(address(HASH), content=other).status_code == 204
    assert "folders/ropod_001" not in _standing(home)
    read = home.client("admin").get(f"/api/v1/robots/ropod_001/folder/{HASH}/robot.yaml")
    assert read.content == FILES["robot.yaml"]


def test_a_robot_writes_its_own_folder_only(home: House) -> None:
    answer = home.robot_client("ropod_002").put(address("ab" * 32), content=pack(FILES))
    assert answer.status_code == 204
    assert f"ropod_002/{'ab' * 32}/robot.yaml" in _standing(home)
    assert home.client("admin").put(address(HASH), content=pack(FILES)).status_code == 403


@pytest.mark.parametrize(
    "name", ["../../server.db", "modes/evil.py", "/etc/passwd.yaml", "a/../../../b.yaml"]
)
def test_what_leads_elsewhere_or_runs_is_refused_whole(home: House, name: str) -> None:
    before = _standing(home)
    answer = home.robot_client().put(
        address("cd" * 32), content=_evil({"robot.yaml": b"", name: b"x"})
    )
    assert answer.status_code == 400
    assert "is not taken" in answer.json()["error"]["what"]
    assert _standing(home) == before


def test_a_bomb_is_refused(home: House) -> None:
    before = _standing(home)
    answer = home.robot_client().put(
        address("ef" * 32), content=_evil({"bomb.txt": bytes(256 << 20)})
    )
    assert answer.status_code == 400
    assert _standing(home) == before


def test_too_much_is_refused_unread(home: House) -> None:
    answer = home.robot_client().put(address("ef" * 32), content=bytes(TAKEN_BYTES + 1))
    assert answer.status_code == 413


@pytest.mark.parametrize("path", ["../../robot.yaml", "..%2F..%2Fserver.db", "robot.yaml%00", "x"])
def test_reading_does_not_lead_elsewhere(home: House, path: str) -> None:
    answer = home.client("admin").get(f"/api/v1/robots/ropod_001/folder/{HASH}/{path}")
    assert answer.status_code == 404


def test_a_hash_is_no_path(home: House) -> None:
    answer = home.robot_client().put("/link/v1/folders/..%2Fropod_002", content=pack(FILES))
    assert answer.status_code in (404, 422)


def test_python_that_somebody_planted_is_not_shown(home: House, tmp_path: Path) -> None:
    place = home.services.folders.find("ropod_001", HASH)
    (place / "evil.py").write_text("raise SystemExit", encoding="utf-8")
    try:
        files = home.client("admin").get(f"/api/v1/robots/ropod_001/folder/{HASH}").json()["files"]
        assert "evil.py" not in [file["name"] for file in files]
    finally:
        (place / "evil.py").unlink()
