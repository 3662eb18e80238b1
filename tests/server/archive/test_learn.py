"""Numbers of a local analysis are learnt from a robot's record in an archive, as from its own."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from amberbox.cli.main import main
from amberbox.server.archive.folder import FolderArchive
from tests.cli.diagnosed import FMEA, Bench, write_folder
from tests.server.archive.recordings import Robot


def test_the_archive_tells_what_the_robot_tells(
    archive: FolderArchive, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    bench = Bench(write_folder(tmp_path / "robot"))
    with bench.watched():
        for _ in range(3):
            bench.run(3)
            bench.run(4, temperature=95.0)
            bench.run(4)
    bench.box.close()
    for second in (8, 19):
        at = ["--at", str(1_700_000_000 + second), "--cause", "motor#worn"]
        assert main(["annotate", str(bench.folder), "the bearing", *at]) == 0
    robot = Robot("robot", tmp_path / "sent")
    robot.folder.mkdir()
    robot.store.symlink_to(bench.folder / "store", target_is_directory=True)
    robot.hand_in_all(archive)
    archive.commit()
    file = tmp_path / "fmea.yaml"
    file.write_text(FMEA)
    capsys.readouterr()
    answers = []
    for where in (str(bench.folder), str(archive.layout.folder / "journals" / "robot")):
        status = main(["fmea", "learn", str(file), where, "--json"])
        printed = capsys.readouterr()
        assert status == 0, printed.err
        answers.append(json.loads(printed.out))
    own, archived = answers
    assert own["situations"]["repairs"] == archived["situations"]["repairs"] == 2
    assert own["situations"]["unsaid"] == archived["situations"]["unsaid"] == 1
    told = [[one for one in of["proposals"] if one["kind"] == "detects"] for of in answers]
    assert told[0] == told[1] and len(told[0]) == 2
