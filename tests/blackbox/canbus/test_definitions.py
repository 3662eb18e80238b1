"""DBC and EDS files as layouts: values as cantools decodes them, errors with their line."""

from __future__ import annotations

import random
import warnings
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import cantools
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from amberbox.blackbox.canbus.dbc import read_dbc
from amberbox.blackbox.canbus.definition import CanDefinition, CanDefinitions
from amberbox.blackbox.canbus.eds import read_eds
from amberbox.blackbox.canbus.files import read_definitions
from amberbox.blackbox.columns.unroll import unroller
from amberbox.core.errors import AmberboxError
from tests.support.can_bus import DBC, EDS

FILE = Path("base.dbc")


def rows(definition: CanDefinition, data: Sequence[bytes]) -> list[dict[str, Any]]:
    """Return the values of frames that are there, by their paths."""
    reader = unroller(definition.topic)
    found = reader.rows(data).columns
    names = {column.path: column.name for column in reader.schema.columns}
    lists = {path: np.ma.MaskedArray(found[name]).tolist() for path, name in names.items()}
    return [
        {path: values[n] for path, values in lists.items() if values[n] is not None}
        for n in range(len(data))
    ]


def test_values_are_those_of_cantools() -> None:
    database: Any = cantools.database.load_string(DBC, "dbc")
    chance = random.Random(7)
    for definition in read_dbc(FILE, DBC):
        message = database.get_message_by_name(definition.topic.name)
        assert (message.frame_id, message.is_extended_frame) == (definition.id, definition.extended)
        frames = [chance.randbytes(message.length) for _ in range(200)]
        if definition.topic.name == "BATTERY":
            frames = [bytes([page << 4]) + frame[1:] for page in (0, 1) for frame in frames]
        for frame, row in zip(frames, rows(definition, frames), strict=True):
            assert row == pytest.approx(message.decode(frame, decode_choices=False), nan_ok=True)


def test_a_signal_of_another_page_or_beyond_a_short_frame_is_null() -> None:
    battery = next(d for d in read_dbc(FILE, DBC) if d.topic.name == "BATTERY")
    assert rows(battery, [bytes([0x70, 0, 0, 0, 0, 0, 0, 4]), b"\x10"]) == [
        {"PAGE": 7, "LEVEL": 2.0},
        {"PAGE": 1},
    ]


def test_units_and_labels_are_in_the_schema() -> None:
    motors = read_dbc(FILE, DBC)[0]
    columns = {column.name: column for column in unroller(motors.topic).schema.columns}
    assert columns["SPEED_L"].unit == "rad/s"
    assert columns["STATE"].labels == {0: "off", 1: "on", 5: "fault"}
    assert columns["CURRENT"].type == "float32"


def test_tpdos_heartbeat_and_emergencies_of_a_node() -> None:
    found = {d.topic.name: d for d in read_eds("lift", 5, Path("lift.eds"), EDS)}
    assert {name: d.id for name, d in found.items()} == {
        "lift/heartbeat": 0x705, "lift/emergency": 0x85, "lift/TPDO1": 0x185, "lift/TPDO3": 0x385,
    }  # fmt: skip
    status = (0x1234).to_bytes(2, "little") + (-7).to_bytes(4, "little", signed=True)
    assert rows(found["lift/TPDO1"], [status]) == [
        {"Statusword": 0x1234, "Position actual value": -7}
    ]
    load = np.float32(2.5).tobytes()
    assert rows(found["lift/TPDO3"], [b"\x01" + load]) == [
        {"Sensor/Brake": True, "Sensor/Load": 2.5}
    ]
    assert rows(found["lift/heartbeat"], [b"\x05"]) == [{"state": 5}]
    emergency = rows(found["lift/emergency"], [bytes([0x10, 0x23, 1, 1, 2, 3, 4, 5])])
    assert emergency == [
        {"code": 0x2310, "error_register": 1, "manufacturer": b"\x01\x02\x03\x04\x05"}
    ]


@pytest.mark.parametrize(
    ("old", "new", "error"),
    [
        ("(0.5,-3)", "(0.5,-3", "base.dbc:6: not understood from >>!<< on"),
        ("16|12@1-", "16|65@1-", "base.dbc:7: signal SPEED_R of MOTORS has 65 bits"),
        ("28|3@1+", "9999|3@1+", "base.dbc:8: signal STATE of MOTORS begins at bit 9999"),
        ("32|32@1-", "32|31@1-", "base.dbc:9: signal CURRENT of MOTORS is a float of 31 bits"),
        ("BO_ 514 LAMP", "BO_ 513 LAMP", "LAMP has the identifier 0x201, as MOTORS"),
        ("BO_ 514 LAMP", "BO_ 514 frames", "there is a topic frames already"),
    ],
)
def test_errors_of_a_dbc_name_file_and_line(old: str, new: str, error: str) -> None:
    assert old in DBC
    with pytest.raises(AmberboxError, match=r"^base\.dbc:\d+: ") as caught:
        CanDefinitions(read_dbc(FILE, DBC.replace(old, new)))
    assert error in caught.value.what
    assert caught.value.hint


@pytest.mark.parametrize(
    ("old", "new", "error"),
    [
        ("0x60410010", "0x77770010", "lift.eds:29: object 7777.00 is mapped, but not described"),
        ("0x60640020", "much", "lift.eds:31: 'much' is no number"),
        ("DefaultValue=2", "DefaultValue=200", "[1a00] maps 200 objects"),
        ("[6041]", "6041", "lift.eds:4: neither [SECTION] nor KEY=VALUE"),
        ("0x21000120", "0x21000121", "is a float of 33 bits"),
    ],
)
def test_errors_of_an_eds_name_file_and_line(old: str, new: str, error: str) -> None:
    assert old in EDS
    with pytest.raises(AmberboxError, match=r"^lift\.eds:\d+: ") as caught:
        read_eds("lift", 5, Path("lift.eds"), EDS.replace(old, new, 1))
    assert error in caught.value.what


def test_a_missing_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(AmberboxError, match=r"cannot read .*base\.dbc: No such file"):
        read_definitions([tmp_path / "base.dbc"])


@pytest.mark.fuzz
@given(st.data())
def test_hostile_files_are_errors_or_definitions(data: st.DataObject) -> None:
    readers: list[tuple[str, Callable[[str], Sequence[CanDefinition]]]] = [
        (DBC, lambda text: read_dbc(FILE, text)),
        (EDS, lambda text: read_eds("lift", 5, Path("lift.eds"), text)),
    ]
    for text, read in readers:
        at = data.draw(st.integers(0, len(text)))
        length = data.draw(st.integers(0, 12))
        put = data.draw(
            st.text(max_size=8) | st.sampled_from(["99999999999999999999", "-1", "e999"])
        )
        try:
            with warnings.catch_warnings(action="ignore"):
                found = CanDefinitions(read(text[:at] + put + text[at + length :]))
        except AmberboxError as error:
            assert ":" in error.what and "\n" not in error.what
            continue
        for topic in found.topics:
            unroller(topic).rows([b"", bytes(8), bytes(64)])
