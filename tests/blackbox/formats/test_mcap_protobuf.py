"""MCAP files written by foxglove-sdk: their protobuf messages are columns after an import."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import foxglove
import numpy as np
import pytest
from foxglove import Context
from foxglove import messages as fox
from foxglove.channels import LaserScanChannel, LogChannel, PoseInFrameChannel
from mcap.reader import make_reader

import amberbox
from amberbox.cli.main import main
from amberbox.core.clock import NS
from amberbox.core.types import ColumnData, Ragged

T0_S = 1_700_000_000


def listed(column: ColumnData) -> list[Any]:
    assert not isinstance(column, Ragged)
    values: list[Any] = column.tolist()
    return values


@pytest.fixture
def recording(tmp_path: Path) -> Path:
    """Write a scan, a pose and a log line, with own stamps, by the writer of the SDK."""
    path, context = tmp_path / "fox.mcap", Context()
    with foxglove.open_mcap(path, context=context):
        poses = PoseInFrameChannel("/pose", context=context)
        scans = LaserScanChannel("/scan", context=context)
        logs = LogChannel("/log", context=context)
        for n in range(300):
            stamp = fox.Timestamp(T0_S + n, n * 1000)
            log_time = T0_S * NS + n * NS
            pose = fox.Pose(
                position=fox.Vector3(x=n / 2, y=-1.0, z=0.0),
                orientation=fox.Quaternion(x=0.0, y=0.0, z=0.0, w=1.0),
            )
            poses.log(
                fox.PoseInFrame(timestamp=stamp, frame_id="map", pose=pose), log_time=log_time
            )
            scans.log(
                fox.LaserScan(timestamp=stamp, frame_id="laser", ranges=[n * 0.1] * (n % 5)),
                log_time=log_time,
            )
            level = fox.LogLevel.Error if n == 7 else fox.LogLevel.Info
            logs.log(fox.Log(timestamp=stamp, level=level, message=f"line {n}"), log_time=log_time)
    return path


def test_files_of_the_sdk_are_columns(recording: Path) -> None:
    with amberbox.open(recording) as record:
        items = {info.name: info.rows for info in record.items()}
        poses = record.query("ros_pose", ["pose/position/x", "frame_id", "orientation/w"])
        assert listed(poses["pose_position_x"]) == [n / 2 for n in range(300)]
        assert set(listed(poses["frame_id"])) == {"map"}
        assert listed(poses["timestamp"]) == [(T0_S + n) * NS + n * 1000 for n in range(300)]
        scans = record.query("ros_scan", ["ranges"])
        assert isinstance(scans["ranges"], Ragged)
        assert np.diff(scans["ranges"].offsets).tolist() == [n % 5 for n in range(300)]
        assert list(scans["ranges"][4]) == [0.4] * 4
        level = next(c for c in record.variables("ros_log").columns if c.name == "level")
        assert level.labels[4] == "ERROR"
        found = record.query("ros_log", ["level", "message"])
        assert listed(found["message"])[7] == "line 7"
        assert listed(found["level"]) == [4 if n == 7 else 2 for n in range(300)]
    assert items["ros_pose"] == items["ros_scan"] == items["ros_log"] == 300


def test_exports_keep_the_messages_and_plots_show_them(
    recording: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    store, out = tmp_path / "store", tmp_path / "out.mcap"
    assert main(["import", str(recording), "--store", str(store)]) == 0
    assert main(["export", str(store), "-o", str(out)]) == 0
    with recording.open("rb") as before, out.open("rb") as after:
        was, now = make_reader(before), make_reader(after)
        wanted = [(c.topic, s.data, m.data) for s, c, m in was.iter_messages() if s]
        kept = [(c.topic, s.data, m.data) for s, c, m in now.iter_messages() if s]
    assert sorted(wanted) == sorted(kept) and len(kept) == 900
    picture = tmp_path / "x.svg"
    assert main(["plot", str(store), "ros_pose", "position/x", "-o", str(picture)]) == 0
    assert b"<svg" in picture.read_bytes()
    assert main(["query", str(out), "ros_pose", "position/x", "--json"]) == 0
    assert '"pose_position_x": 149.5' in capsys.readouterr().out
