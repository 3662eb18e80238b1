"""Folders on the server: whole or not at all, masked, bounded, wanted once."""

from __future__ import annotations

import tempfile
from pathlib import Path

import msgspec
import pytest
import zstandard
from hypothesis import given, settings
from hypothesis import strategies as st

from amberbox.core.clock import NS
from amberbox.core.errors import UsageError
from amberbox.link.folders import FolderError, pack
from amberbox.link.frames import Hello
from amberbox.server.ingest import folders
from amberbox.server.ingest.folders import FolderService, FolderStore
from amberbox.server.ingest.worker import keep, masked
from tests.fuzzing import examples, fuzz
from tests.server.house import House

A, B, C = "a" * 64, "b" * 64, "c" * 64
SECRET = "hunter2-tr0ub4dor"


def _hello(config_hash: str) -> Hello:
    return Hello("ropod_001", "s", "b", {}, config_hash, 0, 0, "1")


def test_a_folder_is_wanted_until_it_is_here(home: House) -> None:
    links, kept = home.services.links, home.services.folders
    assert links._wants_folder(_hello(A))
    assert not links._wants_folder(_hello(""))
    assert not links._wants_folder(_hello("../etc"))
    assert kept.keep("ropod_001", A, pack({"robot.yaml": b""}))
    assert not links._wants_folder(_hello(A))
    assert kept.wants("ropod_002", A)


def test_what_is_here_is_known_after_a_restart(home: House) -> None:
    of = home.services
    of.folders.keep("ropod_001", A, pack({"robot.yaml": b""}))
    again = FolderService(of.folder, of.database, of.bus, of.clock, of.worker_pool)
    assert not again.wants("ropod_001", A)


def test_a_folder_written_before_a_crash_is_taken_up_again(home: House) -> None:
    kept = home.services.folders
    kept.shelf.keep("ropod_001", A, {"robot.yaml": b"id: first\n"})  # and the server dies here
    assert kept.keep("ropod_001", A, pack({"robot.yaml": b"id: second\n"}))
    assert kept.read("ropod_001", A, "robot.yaml") == b"id: first\n"


def test_what_was_on_its_way_is_removed(tmp_path: Path) -> None:
    left = tmp_path / "folders" / "ropod_001" / "coming-x1"
    left.mkdir(parents=True)
    FolderStore(tmp_path).tidy()
    assert not left.exists()


def test_a_folder_that_cannot_be_written_leaves_nothing(tmp_path: Path) -> None:
    shelf = FolderStore(tmp_path)
    with pytest.raises(OSError, match=r"Is a directory|Not a directory|File exists"):
        shelf.keep("ropod_001", A, {"a.yaml": b"", "a.yaml/b.yaml": b""})
    assert list((tmp_path / "folders" / "ropod_001").iterdir()) == []


def test_a_robot_has_so_many_folders_at_most(home: House, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(folders, "MOST", 2)
    kept = home.services.folders
    for config_hash in (A, B, C):
        kept.keep("ropod_001", config_hash, pack({"robot.yaml": b""}))
        home.clock.advance(NS)
    assert [folder.config_hash for folder in kept.kept("ropod_001")] == [C, B]
    assert kept.wants("ropod_001", A)
    assert not kept.shelf.place("ropod_001", A).exists()


def test_the_folder_of_an_unknown_hash_is_not_here(home: House) -> None:
    kept = home.services.folders
    with pytest.raises(UsageError, match="the folder of ropod_001 is not here"):
        kept.find("ropod_001")
    kept.keep("ropod_001", A, pack({"robot.yaml": b""}))
    assert kept.find("ropod_001") == kept.shelf.place("ropod_001", A)
    with pytest.raises(UsageError, match="is not here: bbbb"):
        kept.find("ropod_001", B)


def test_secrets_that_a_robot_let_through_are_masked(home: House) -> None:
    planted = {
        "robot.yaml": f"server: {{url: 'https://x', token: {SECRET}}}\n",
        "black_box.yaml": f"- zmq: {{url: 'tcp://me:{SECRET}@host:1', password: '{SECRET}'}}\n",
        "components/broken.yaml": f"a: [\nmqtt_password: {SECRET}\n",
        "readme.md": f"Router: http://admin:{SECRET}@10.0.0.1/\n  api_key = {SECRET}\n",
        "keys.txt": f"-----BEGIN PRIVATE KEY-----\n{SECRET}\n-----END PRIVATE KEY-----\n",
        "net.xml": f"<password>{SECRET}</password>\n",
        "plain.yaml": "id: ropod_001\ndescription: no secret here\n",
    }
    kept = home.services.folders
    kept.keep("ropod_001", A, pack({name: text.encode() for name, text in planted.items()}))
    for name in planted:
        text = kept.read("ropod_001", A, name)
        assert text is not None
        assert SECRET.encode() not in text, name
    root = home.services.folder
    everywhere = (path for path in root.rglob("*") if path.is_file())
    assert [path for path in everywhere if SECRET.encode() in path.read_bytes()] == []
    assert [folder.masked for folder in kept.kept("ropod_001")] == [6]
    assert kept.read("ropod_001", A, "plain.yaml") == planted["plain.yaml"].encode()


def test_what_robots_send_is_read_by_workers_of_its_own(home: House) -> None:
    """People's questions never wait behind it: nothing of it is put where these are answered."""
    for_people: list[str] = []
    home.services.worker_pool.submit = lambda task: for_people.append(task.op)  # type: ignore[method-assign]  # a pool that only notes
    kept = home.services.folders
    assert kept.keep("ropod_001", A, pack({"robot.yaml": b"id: ropod_001\n"}))
    assert home.services.feed.state.facts.read("ropod_001", A).model == ""
    assert for_people == [] and home.services.robot_worker_pool.pids
    with pytest.raises(UsageError, match="no packed folder"):
        kept.keep("ropod_001", B, b"nonsense")


HOSTILE = st.dictionaries(
    st.sampled_from(
        ("a.yaml", "../b.yaml", "/etc/passwd.txt", "a.yaml/b.yaml", "x/../../y.md", "c\x00.txt",
         ".hidden/d.yaml", "e.py", "CON.txt", "f" * 300 + ".txt", "g/" * 20 + "h.txt", "i.yaml ",
         "ok/j.yaml", "k.xml", "l\n.md", "robot.yaml", "m.txt")
    ),
    st.sampled_from(
        (b"", b"\xff\xfe", b"[" * 20_000, b"{a: " * 5_000, b"- " * 20_000, b"\n" * 200_000,
         b"a: &a [x, x]\nb: &b [*a, *a]\nc: &c [*b, *b]\nd: [*c, *c, *c]\n", b"a: &a {b: *a}\n",
         b"!!python/object/apply:os.system ['touch /tmp/x']\n", b"token: " + b"x" * 100_000,
         b"<password " * 20_000, b"secret" * 30_000, b"password: hunter2-tr0ub4dor\n" * 500,
         b"-----BEGIN PRIVATE KEY-----\n" * 2_000, b"%YAML 9.9\n---\n? [a]\n: b\n")
    ),
    max_size=6,
)  # fmt: skip


@fuzz
@given(HOSTILE, st.booleans(), st.binary(max_size=40))
@settings(max_examples=examples(25))
def test_a_hostile_folder_is_taken_whole_and_masked_or_refused(
    files: dict[str, bytes], cut: bool, rubbish: bytes
) -> None:
    """Nothing lands elsewhere, and no other error is raised."""
    packed = zstandard.compress(msgspec.msgpack.encode(files))
    packed = packed[: len(packed) // 2] + rubbish if cut else packed
    with tempfile.TemporaryDirectory() as folder:
        root = Path(folder) / "server"
        root.mkdir()
        try:
            keep(root, {"robot": "r1", "config_hash": A, "data": packed})
        except FolderError:
            assert not list(root.rglob("*.*"))
        else:
            place = root / "folders" / "r1" / A
            written = [path for path in Path(folder).rglob("*") if path.is_file()]
            assert all(path.is_relative_to(place) for path in written)
            assert {str(path.relative_to(place)) for path in written} == set(files)
            assert not any(b"hunter2" in path.read_bytes() for path in written)


def test_masking_leaves_the_simulated_robot_alone() -> None:
    root = Path(folders.__file__).parents[2] / "sim" / "folder"
    files = {p.relative_to(root).as_posix(): p.read_bytes() for p in root.rglob("*.[yp]*l")}
    assert len(files) > 50
    assert masked(files) == (files, [])
