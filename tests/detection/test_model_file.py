"""Model files: what is written is read again, and no file does harm."""

from __future__ import annotations

import io
import json
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from amberbox.core.errors import AmberboxError, UsageError
from amberbox.detection.model_file import (
    DetectionModel,
    detector_names,
    load_model,
    make_detector,
    model_bytes,
    read_model,
    save_model,
)
from amberbox.testing.detectors import nominal_missions


def make_model() -> DetectionModel:
    missions = nominal_missions(4)
    detectors = {}
    for name in ("event_timing", "guard"):
        detector = make_detector(name)
        detector.fit(missions[:2])
        detector.calibrate(missions[2:], 50.0)
        detectors[name] = detector
    return DetectionModel(detectors, {"robot": "test"})


MODEL = make_model()
DATA = model_bytes(MODEL)


def parts() -> dict[str, bytes]:
    with zipfile.ZipFile(io.BytesIO(DATA)) as archive:
        return {name: archive.read(name) for name in archive.namelist()}


def packed(entries: dict[str, bytes]) -> bytes:
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, data in entries.items():
            archive.writestr(name, data)
    return buffer.getvalue()


def test_a_model_is_the_same_after_a_file(tmp_path: Path) -> None:
    save_model(MODEL, tmp_path / "robot.model")
    read = load_model(tmp_path / "robot.model")
    assert read.origin == {"robot": "test"}
    assert model_bytes(read) == DATA
    fresh = nominal_missions(1, seed=8)[0]
    for name, detector in MODEL.detectors.items():
        ours, theirs = detector.score(fresh), read.detectors[name].score(fresh)
        assert np.array_equal(ours.value, theirs.value)
        assert np.array_equal(ours.p_value, theirs.p_value)
        assert read.detectors[name].calibration == detector.calibration


def test_detectors_are_found_by_name() -> None:
    assert {"event_timing", "guard"} <= {*detector_names()}
    with pytest.raises(UsageError, match="did you mean 'guard'"):
        make_detector("gard")


def _changed(change: Callable[[dict[str, Any]], object]) -> dict[str, bytes]:
    entries = parts()
    values = json.loads(entries["model.json"])
    change(values)
    entries["model.json"] = json.dumps(values).encode()
    return entries


def _array(array: np.ndarray[Any, Any], *, pickled: bool = False) -> bytes:
    part = io.BytesIO()
    np.lib.format.write_array(part, array, allow_pickle=pickled)
    return part.getvalue()


PERIOD = "event_timing/learnt_period_s.npy"
WRONG = {
    "another version": lambda: _changed(lambda v: v.update(amberbox_model=9)),
    "no detectors": lambda: _changed(lambda v: v.update(detectors=[])),
    "unknown detector": lambda: _changed(lambda v: v["detectors"].update(oracle={})),
    "version of a detector": lambda: _changed(lambda v: v["detectors"]["guard"].update(version=9)),
    "limits of text": lambda: _changed(
        lambda v: v["detectors"]["guard"]["learnt"]["items"][0].update(mean_hz="x")
    ),
    "no rate": lambda: _changed(
        lambda v: v["detectors"]["guard"]["learnt"]["items"][0].update(mean_hz=0)
    ),
    "pairs": lambda: _changed(
        lambda v: v["detectors"]["event_timing"]["learnt"].update(pairs=[[99]] * 3)
    ),
    "a list as origin": lambda: _changed(lambda v: v.update(origin=[])),
    "series": lambda: _changed(
        lambda v: v["detectors"]["guard"]["calibration"]["series"].update(fleet=["a"])
    ),
    "not finite": lambda: parts() | {"model.json": b'{"amberbox_model": NaN}'},
    "deep": lambda: parts() | {"model.json": b"[" * 100_000},
    "objects": lambda: parts() | {PERIOD: _array(np.array([{}]), pickled=True)},
    "text array": lambda: parts() | {PERIOD: _array(np.array(["a"]))},
    "short array": lambda: parts() | {PERIOD: parts()[PERIOD][:-1]},
    "other shape": lambda: parts() | {PERIOD: _array(np.zeros((2, 2)))},
    "NaN in an array": lambda: parts() | {PERIOD: _array(np.full(3, np.nan))},
    "a strange part": lambda: parts() | {"../../x.npy": b""},
    "a part missing": lambda: {n: d for n, d in parts().items() if n != PERIOD},
}


@pytest.mark.parametrize("what", WRONG)
def test_a_wrong_file_is_a_clear_error(what: str, tmp_path: Path) -> None:
    path = tmp_path / "wrong.model"
    path.write_bytes(packed(WRONG[what]()))
    with pytest.raises(AmberboxError) as caught:
        load_model(path)
    assert str(path) in caught.value.what
    assert caught.value.hint


def test_a_bomb_and_a_large_file_are_refused(tmp_path: Path) -> None:
    bomb = packed(parts() | {"guard/zeros.npy": bytes(70 << 20)})
    assert len(bomb) < 8 << 20
    with pytest.raises(AmberboxError, match="when unpacked"):
        read_model(bomb, "bomb")
    (tmp_path / "large").write_bytes(bytes((8 << 20) + 1))
    with pytest.raises(AmberboxError, match="more than 8 MiB"):
        load_model(tmp_path / "large")
    with pytest.raises(AmberboxError, match="cannot read"):
        load_model(tmp_path / "nothing")


@settings(max_examples=150)
@given(st.integers(0, len(DATA) - 1), st.binary(min_size=1, max_size=8), st.booleans())
def test_a_damaged_file_raises_nothing_else(place: int, junk: bytes, cut: bool) -> None:
    data = DATA[:place] if cut else DATA[:place] + junk + DATA[place + len(junk) :]
    try:
        read_model(data, "damaged")
    except AmberboxError as error:
        assert error.what.startswith("damaged: ")
