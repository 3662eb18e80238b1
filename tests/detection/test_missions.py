"""Missions as detectors read them: which there are, elements of lists, parts of time."""

from __future__ import annotations

import math
from pathlib import Path

import pytest

from amberbox.blackbox.query.record import open as open_record
from amberbox.cli.main import main
from amberbox.core.clock import NS
from amberbox.detection.missions import MOST_ELEMENTS, missions_of
from amberbox.detection.model_file import load_model
from amberbox.testing.records import T0_NS, FakeItem, FakeRun

LIMB = {
    "position": [0.5, 1.5, 2.5], "torque": [1.0], "names": ["a", "b"],
    "ranges": [0.25] * (MOST_ELEMENTS + 1),
}  # fmt: skip
LIMBS = FakeItem("limbs", [LIMB])
_STEP_NS = NS // 10


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a store of 25 minutes in which three joints swing; once a joint is missing."""
    path = tmp_path_factory.mktemp("limbs") / "store"
    run = FakeRun(path, items=[LIMBS])
    rows = []
    for number in range(1500):
        position = [math.sin(number / 20 + joint) for joint in range(2 if number == 40 else 3)]
        torque = [0.5] * (MOST_ELEMENTS + 3) if number == 50 else [0.1 * number % 1]
        rows.append((T0_NS + number * NS, LIMBS, {**LIMB, "position": position, "torque": torque}))
    run.write(rows)
    run.close()
    return path


def test_elements_of_short_lists_are_variables(store: Path) -> None:
    with open_record(store) as record:
        (mission,) = missions_of(record)
        rows = list(mission)
    assert len(rows) == 1500 and [row.at_ns for row in rows] == sorted(row.at_ns for row in rows)
    assert set(rows[0].values) == {"position[0]", "position[1]", "position[2]", "torque[0]"}
    assert rows[7].values["position[2]"] == pytest.approx(math.sin(7 / 20 + 2))
    assert set(rows[40].values) == {"position[0]", "position[1]", "torque[0]"}
    assert not [name for name in rows[50].values if name.startswith("torque")]


def test_a_range_of_time_is_a_part_of_the_rows(store: Path) -> None:
    span = T0_NS + 590 * NS, T0_NS + 1210 * NS  # over the borders of what is read at once
    with open_record(store) as record:
        (mission,), (whole,) = missions_of(record, (), span), missions_of(record)
        assert mission.span == span
        assert list(mission) == [row for row in whole if span[0] <= row.at_ns < span[1]]
        assert missions_of(record, (), (T0_NS - NS, T0_NS)) == []


def test_detectors_learn_them_and_find_them(
    store: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    model, folder = tmp_path / "limbs.model", tmp_path / "robot"
    options = tmp_path / "options.yaml"
    options.write_text("residual: {variables: ['limbs.position[*]']}\n")
    words = ["--detectors", "guard", "residual", "--options", str(options), "-o", str(model)]
    assert main(["learn", str(store), "--to", "2026-09-21T14:33:20Z", *words]) == 0
    assert set(load_model(model).detectors) == {"guard", "residual"}
    faulty = tmp_path / "faulty"
    run = FakeRun(faulty, items=[LIMBS])
    run.write([
        (T0_NS + n * NS, LIMBS, {**LIMB, "position": [0.1, 0.2, 0.3 if n < 60 else 9.0]})
        for n in range(120)
    ])  # fmt: skip
    run.close()
    capsys.readouterr()
    assert main(["detect", str(faulty), str(model), "--replay"]) == 0
    assert "guard.jump.limbs.position[2]" in capsys.readouterr().out
    folder.mkdir()
    (folder / "robot.yaml").write_text("id: r\n")
    (folder / "black_box.yaml").write_text("- file: {path: limbs.jsonl, item: limbs}\n")
    assert main(["learn", str(store), "--monitors", str(folder)]) == 0
    written = "".join(file.read_text() for file in folder.glob("components/**/*.yaml"))
    assert '"limbs.position[2]"' in written and "range_position_2" in written
