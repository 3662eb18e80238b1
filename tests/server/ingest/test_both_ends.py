"""Secrets planted on a robot: masked there, so that here nothing is left to mask."""

from __future__ import annotations

from pathlib import Path

from amberbox.agent.folder_upload import packed_folder
from amberbox.blackbox.robot_folder.folder import load_folder
from amberbox.link.folders import address
from tests.server.house import house

SECRET = "hunter2-tr0ub4dor"
FILES = {
    "robot.yaml": f"id: ropod_001\nserver: {{url: 'https://fleet.example', token: {SECRET}}}\n",
    "black_box.yaml": "- zmq: {endpoint: 'tcp://127.0.0.1:9', topics: [{name: t}]}\n",
    "components/camera.yaml": "component_name: camera\n",
    "notes.md": f"The router: http://admin:{SECRET}@10.0.0.1/\n\n    api_key = {SECRET}\n",
    "more.yaml": f"mqtt: {{user: robot, password: '{SECRET}'}}\n",
    "net.xml": f"<net><password>{SECRET}</password></net>\n",
    "modes/own.py": f"PASSWORD = '{SECRET}'\n",
}


def test_what_a_robot_masked_needs_no_mask_here(tmp_path: Path) -> None:
    folder = tmp_path / "ropod_001"
    for name, text in FILES.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(text, encoding="utf-8")
    robot = load_folder(folder)
    with house(tmp_path / "server") as home:
        path = address(robot.config_hash)
        assert home.robot_client().put(path, content=packed_folder(robot)).status_code == 204
        (kept,) = home.services.folders.kept("ropod_001")
        assert (kept.files, kept.masked) == (len(FILES) - 1, 0)
        held = [p for p in (tmp_path / "server").rglob("*") if p.is_file()]
        assert [p for p in held if SECRET.encode() in p.read_bytes()] == []
        camera = home.services.folders.read("ropod_001", kept.config_hash, "components/camera.yaml")
        assert camera == FILES["components/camera.yaml"].encode()
