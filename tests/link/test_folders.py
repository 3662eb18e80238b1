"""The transfer of folders: which files are sent, which are refused."""

from __future__ import annotations

import msgspec
import pytest
import zstandard

from amberbox.link import folders
from amberbox.link.folders import (
    PICTURE_BYTES,
    PICTURES_BYTES,
    TAKEN_BYTES,
    UNPACKED_BYTES,
    FolderError,
    pack,
    travels,
    unpack,
)


def _packed(files: object) -> bytes:
    """Pack any content, as an attacker would."""
    return zstandard.ZstdCompressor().compress(msgspec.msgpack.encode(files))


def test_what_was_packed_is_unpacked() -> None:
    files = {"robot.yaml": b"id: a\n", "components/laser/alive.yaml": b"name: x\n", "why.md": b""}
    assert unpack(pack(files)) == files


def test_what_runs_stays_at_home() -> None:
    files = {
        "robot.yaml": b"",
        "modes/own.py": b"import os",
        ".git/x.yaml": b"",
        "store/a.mcap": b"",
    }
    assert list(unpack(pack(files))) == ["robot.yaml"]


def test_names_that_travel() -> None:
    assert all(map(travels, ("robot.yaml", "rules/a.pl", "maps/B.CSV", "mit umlaut ä.yml")))
    assert not any(map(travels, ("a.py", "a.yaml.py", ".a.yaml", "../a.yaml", "a", "a.so")))


def test_pictures_of_experiments_go_to_servers_that_take_them() -> None:
    files = {
        "experiments/way.png": b"\x89PNG", "experiments/a.SVG": b"<svg/>", "robot.yaml": b"",
        "experiments/deep/b.png": b"", "logo.png": b"", "experiments/.c.jpg": b"",
    }  # fmt: skip
    assert list(unpack(pack(files))) == ["robot.yaml"]
    assert list(unpack(pack(files, pictures=True))) == [
        "experiments/a.SVG", "experiments/way.png", "robot.yaml",
    ]  # fmt: skip
    with pytest.raises(FolderError, match=r"logo.png.*pictures of experiments/"):
        unpack(_packed({"logo.png": b""}))


def test_pictures_are_bounded() -> None:
    with pytest.raises(FolderError, match="pictures have"):
        unpack(_packed({"experiments/a.png": bytes(PICTURE_BYTES + 1)}))
    count = PICTURES_BYTES // PICTURE_BYTES + 1
    many = {f"experiments/{n}.png": bytes(PICTURE_BYTES) for n in range(count)}
    with pytest.raises(FolderError, match="pictures have"):
        unpack(_packed(many))


@pytest.mark.parametrize(
    "name",
    ["../robot.yaml", "/etc/robot.yaml", "a/../../b.yaml", "a//b.yaml", "", "a\\b.yaml", "./a.yaml",
     "a\0.yaml", "a/.yaml", "..", "C:/a.yaml", "a" * 300 + ".yaml", "a /b.yaml",
     "/".join("a" * 17)],
)  # fmt: skip
def test_names_that_lead_elsewhere_are_refused(name: str) -> None:
    with pytest.raises(FolderError, match="is not taken"):
        unpack(_packed({name: b""}))


def test_python_is_refused_even_if_a_robot_sends_it() -> None:
    with pytest.raises(FolderError, match=r"modes/evil.py.*only \.bpmn"):
        unpack(_packed({"robot.yaml": b"", "modes/evil.py": b"import os"}))


def test_a_file_is_no_folder_at_the_same_time() -> None:
    with pytest.raises(FolderError, match="a folder of others"):
        unpack(_packed({"a.yaml": b"", "a.yaml/b.yaml": b""}))


def test_a_bomb_does_not_go_off() -> None:
    bomb = _packed({"a.txt": bytes(64 << 20)})
    assert len(bomb) < 100_000
    with pytest.raises(FolderError, match=f"at most {UNPACKED_BYTES + PICTURES_BYTES} bytes"):
        unpack(bomb)


def test_a_bomb_that_does_not_say_how_large_it_is_does_not_go_off() -> None:
    writer = zstandard.ZstdCompressor(write_content_size=False).compressobj()
    bomb = writer.compress(msgspec.msgpack.encode({"a.txt": bytes(64 << 20)})) + writer.flush()
    with pytest.raises(FolderError, match="says how many"):
        unpack(bomb)


def test_files_are_counted() -> None:
    files = {f"{number}.yaml": b"" for number in range(folders.FILES + 1)}
    with pytest.raises(FolderError, match="2001 files"):
        unpack(_packed(files))
    with pytest.raises(FolderError, match="2001 files"):
        pack(files)


def test_too_much_is_refused_before_it_is_read() -> None:
    with pytest.raises(FolderError, match=f"at most {TAKEN_BYTES} bytes"):
        unpack(bytes(TAKEN_BYTES + 1))


_SOUND = _packed({"a.yaml": b""})


@pytest.mark.parametrize(
    "data", [b"", b"nonsense", _packed([1]), _packed({"a.yaml": 1}), _SOUND[:-3], _SOUND + b"x"]
)
def test_what_is_damaged_is_refused(data: bytes) -> None:
    with pytest.raises(FolderError):
        unpack(data)


def test_a_hash_is_64_digits() -> None:
    assert folders.is_config_hash("0123456789abcdef" * 4)
    assert not folders.is_config_hash("../" + "a" * 61)
    assert folders.address("ab") == "/link/v1/folders/ab"
