"""Planted secrets: in every place where configuration allows one; none of them leaves the robot."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import pytest

from amberbox.agent.folder_upload import masked, packed_folder, send_folder
from amberbox.agent.join import write_key
from amberbox.blackbox.robot_folder.folder import SOURCES, load_folder, store_of
from amberbox.blackbox.robot_folder.robot_yaml import KEY_FILE
from amberbox.core.config import field_types
from amberbox.core.plugins import find
from amberbox.core.yaml_nodes import load_yaml
from amberbox.link.folders import unpack
from amberbox.link.uploader import CopyError, UploadReply

KEY = "abr_0123456789ab_" + "K" * 43
PLANTED = "hunter2"
"""Every secret of the folder holds this."""

ROBOT = """\
id: r1
server:
  url: https://fleet.example
  token: hunter2-token      # was hunter2-before
  # old token: hunter2-older
# the password of the account is hunter2-spoken
"""
BLACK_BOX = """\
- zmq:
    url: tcp://robot:hunter2-url@127.0.0.1:5555
    curve_server_key: "0123456789012345678901234567890123456789"
    curve_public_key: "0123456789012345678901234567890123456788"
    curve_secret_key: "hunter2-01234567890123456789012345678901"  # hunter2-beside
    topics: [{name: /a}]
"""
NOTES = """\
# Notes
password: hunter2-note, token = "hunter2 quoted"
the API key is hunter2-apikey
see https://admin:hunter2-wiki@wiki.example/?token=hunter2-query&page=2
the token of the server is hunter2-token
"""
OTHER = """\
camera: {user: operator, password: hunter2-camera, rate: 5}  # hunter2-comment
again: &again {api_key: hunter2-alias, host: lab}
both: [*again, {name: hunter2-camera}]
blocks:
  secret: |
    hunter2-block
    hunter2-lines
  limit: 3  # metres
"""
XML = "<mission user='a' password='hunter2-xml'><token kind='x'>hunter2-element</token></mission>\n"
PEM = "-----BEGIN RSA PRIVATE KEY-----\nhunter2pem\n-----END RSA PRIVATE KEY-----\n"
RULES = "% the secret: hunter2-prolog\nlimit(speed, 3).\n"


@pytest.fixture
def planted(tmp_path: Path) -> Path:
    files = {
        "robot.yaml": ROBOT, "black_box.yaml": BLACK_BOX, "notes.md": NOTES, "cameras.yaml": OTHER,
        "flow.bpmn": XML, "rules.pl": RULES, "plan.csv": "name;password=hunter2-csv\n",
        "code.py": "TOKEN = 'hunter2-python'\n", "data.bin": "hunter2-binary",
        "broken.yaml": "a: [hunter2-broken\n", "id_rsa": "hunter2-file",
        "keys.txt": PEM,
        ".hidden.yaml": "password: hunter2-hidden\n",
    }  # fmt: skip
    for name, text in files.items():
        (tmp_path / name).write_text(text)
    (tmp_path / "latin.txt").write_bytes(b"hunter2-\xff")
    write_key(tmp_path, KEY)
    (tmp_path / "pasted.txt").write_text(f"the line was amberbox+https://r1:{KEY}@fleet\n")
    return tmp_path


def test_no_planted_secret_leaves_the_folder(planted: Path) -> None:
    black_box = (planted / "black_box.yaml").read_text()
    sent = unpack(packed_folder(load_folder(planted)))
    assert black_box.count(PLANTED) == 3
    everything = b"".join(name.encode() + data for name, data in sent.items())
    assert PLANTED.encode() not in everything and KEY[-20:].encode() not in everything
    assert set(sent) == {
        "robot.yaml", "black_box.yaml", "notes.md", "cameras.yaml", "flow.bpmn", "rules.pl",
        "plan.csv", "keys.txt", "pasted.txt",
    }  # fmt: skip
    assert b"limit: 3  # metres" in sent["cameras.yaml"] and b"rate: 5" in sent["cameras.yaml"]
    assert b"limit(speed, 3)." in sent["rules.pl"]
    assert b"url: https://fleet.example" in sent["robot.yaml"]


def test_pictures_are_sent_without_what_is_secret_in_their_text(planted: Path) -> None:
    place = planted / "experiments"
    place.mkdir()
    (place / "way.png").write_bytes(b"\x89PNG\r\n\x1a\n\0")
    (place / "way.svg").write_text(f"<svg><password>{PLANTED}</password></svg>")
    (place / "outside.png").symlink_to("/etc/passwd")
    folder = load_folder(planted)
    assert not {*unpack(packed_folder(folder))} & {"experiments/way.png", "experiments/way.svg"}
    sent = unpack(packed_folder(folder, pictures=True))
    assert sent["experiments/way.png"] == b"\x89PNG\r\n\x1a\n\0"
    assert sent["experiments/way.svg"] == b"<svg><password>(masked)</password></svg>"
    assert "experiments/outside.png" not in sent


def test_what_is_sent_loads_as_the_folder_did(planted: Path, tmp_path: Path) -> None:
    sent = unpack(packed_folder(load_folder(planted)))
    copy = tmp_path / "copy"
    copy.mkdir()
    for name, data in sent.items():
        (copy / name).write_bytes(data)
    assert store_of(copy) == copy / "store"
    root = load_yaml(copy / "black_box.yaml", [])
    assert root is not None and root.items is not None
    assert list(root.items[0].mapping or {}) == ["zmq"]


def test_every_secret_option_of_every_source_is_masked() -> None:
    count = 0
    for plugin in find(SOURCES, defines=("Config", "Source")).values():
        config = plugin.load().Config
        kinds = field_types(config)
        for field in dataclasses.fields(config):
            if field.metadata.get("secret"):
                assert kinds[field.name] is str
                text = f"- {plugin.name}:\n    {field.name}: hunter2-{plugin.name}  # hunter2\n"
                [done] = masked({"black_box.yaml": text.encode()}).values()
                assert PLANTED not in done.decode() and field.name in done.decode()
                count += 1
    assert count


def test_a_folder_that_has_changed_since_is_not_sent(planted: Path) -> None:
    folder = load_folder(planted)
    (planted / "more.yaml").write_text("a: 1\n")
    with pytest.raises(Exception, match="has changed"):
        packed_folder(folder)


def test_the_key_is_no_part_of_the_hash(planted: Path) -> None:
    before = load_folder(planted).config_hash
    write_key(planted, KEY.replace("K", "L"))
    assert load_folder(planted).config_hash == before
    assert (planted / KEY_FILE).stat().st_mode & 0o777 == 0o600


def test_it_is_put_by_its_hash_and_a_refusal_is_told(planted: Path) -> None:
    asked: list[tuple[str, str]] = []

    def send(
        method: str, path: str, headers: dict[str, str], body: bytes | memoryview
    ) -> UploadReply:
        asked.append((method, path))
        return UploadReply(204 if len(asked) == 1 else 507, 0, "", b"full")

    folder = load_folder(planted)
    send_folder(folder, send)
    assert asked == [("PUT", f"/link/v1/folders/{folder.config_hash}")]
    with pytest.raises(CopyError, match="507"):
        send_folder(folder, send)
