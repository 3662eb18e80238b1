"""Raw frames as columns: by layout, against bits read one by one, and through a recording."""

from __future__ import annotations

import random
import struct
from pathlib import Path
from typing import Any

import pytest
from mcap.writer import Writer

import amberbox
from amberbox.blackbox.columns import UnrollError
from amberbox.blackbox.columns.frame_layout import (
    MESSAGE_ENCODING,
    FrameField,
    FrameLayout,
    Switch,
    read_layout,
)
from amberbox.blackbox.columns.unroll import unroller
from amberbox.cli.main import main
from amberbox.core.errors import AmberboxError
from amberbox.core.types import Schema, Topic

NS = 1_000_000_000


def rows_of(layout: FrameLayout, frames: list[bytes], stamp: str | None = None) -> Any:
    topic = Topic("/frames", MESSAGE_ENCODING, layout.to_schema("bus"))
    return unroller(topic, stamp).rows(frames)


def bit_by_bit(frame: bytes, one: FrameField) -> int:
    """Read a number as the layout defines it, one bit after the other."""
    value = 0
    for n in range(one.bits):
        place = one.bit + n
        if one.byte_order == "little":
            value |= (frame[place // 8] >> (place % 8) & 1) << n
        else:
            value = value << 1 | (frame[place // 8] >> (7 - place % 8) & 1)
    negative = one.kind == "int" and value >> (one.bits - 1)
    return value - (1 << one.bits) if negative else value


def test_numbers_of_any_place_width_and_order_are_read() -> None:
    rng = random.Random(1)
    fields = []
    for n in range(400):
        bits = rng.randrange(1, 65)
        kind, order = rng.choice(["uint", "int"]), rng.choice(["little", "big"])
        bit = rng.randrange(0, 16 * 8 - bits + 1)
        fields.append(FrameField(f"f{n}", bit, bits, kind, order))  # type: ignore[arg-type]  # drawn
    frames = [rng.randbytes(16) for _ in range(50)]
    rows = rows_of(FrameLayout(tuple(fields), 16), frames)
    for one in fields:
        values = rows.columns[one.name]
        assert values.dtype == one.column_type
        assert values.tolist() == [bit_by_bit(frame, one) for frame in frames], one


def test_a_signal_of_a_dbc_file_is_at_the_converted_bit() -> None:
    start = 7  # SG_ speed : 7|16@0+ (0.01,0): the first two bytes, the highest first
    speed = FrameField("speed", start // 8 * 8 + 7 - start % 8, 16, "uint", "big", 0.01, unit="m/s")
    rows = rows_of(FrameLayout((speed,)), [struct.pack(">H6x", 12345)])
    assert rows.columns["speed"].tolist() == [pytest.approx(123.45)]


def test_floats_texts_bools_labels_and_units() -> None:
    layout = FrameLayout(
        (
            FrameField("temperature", 0, 32, "float", unit="°C"),
            FrameField("half", 32, 16, "float", "big"),
            FrameField("drive/0/on", 48, 1, "bool"),
            FrameField("state", 49, 3, labels={0: "off", 5: "on"}, unit="", scale=1),
            FrameField("level", 52, 4, "int", scale=0.5, offset=-1, unit="V"),
            FrameField("name", 56, 40, "text"),
            FrameField("rest", 96, 0, "bytes"),
        )
    )
    frame = struct.pack("<f", 21.5) + struct.pack(">e", -2.0) + bytes([0xFB]) + b"ab\0xy" + b"rest"
    topic = Topic("/frames", MESSAGE_ENCODING, layout.to_schema("bus"))
    unroll = unroller(topic)
    rows = unroll.rows([frame])
    values = {name: column.tolist()[0] for name, column in rows.columns.items()}  # type: ignore[union-attr]  # an array
    assert values == {
        "temperature": 21.5, "half": -2.0, "drive_0_on": True, "state": 5, "level": -1.5,
        "name": "ab", "rest": b"rest",
    }  # fmt: skip
    columns = {column.path: column for column in unroll.schema.columns}
    assert columns["temperature"].unit == "°C" and columns["state"].labels == {0: "off", 5: "on"}
    assert columns["drive/0/on"].type == "bool" and columns["level"].type == "float64"


def test_what_is_not_in_a_frame_is_null() -> None:
    layout = FrameLayout(
        (
            FrameField("page", 0, 8),
            FrameField("a", 8, 16, when=Switch("page", (1,))),
            FrameField("b", 8, 8, "int", when=Switch("page", (2, 3)), scale=2),
            FrameField("tail", 24, 0, "text"),
        )
    )
    rows = rows_of(layout, [b"\x01\x02\x00hi", b"\x03\xff", b"", b"\x01\x05", b"\x02\x01\x00"])
    assert rows.columns["page"].tolist() == [1, 3, None, 1, 2]
    assert rows.columns["a"].tolist() == [2, None, None, None, None]
    assert rows.columns["b"].tolist() == [None, -2.0, None, None, 2.0]
    assert rows.columns["tail"].tolist() == ["hi", None, None, None, None]


def test_frames_of_another_size_do_not_fit() -> None:
    layout = FrameLayout((FrameField("a", 0, 8),), size=2)
    with pytest.raises(UnrollError) as caught:
        rows_of(layout, [b"ab", b"", b"abc"])
    assert caught.value.bad == (1, 2)


def test_a_field_may_be_the_own_stamp() -> None:
    layout = FrameLayout((FrameField("at", 0, 64), FrameField("x", 64, 8)))
    frames = [struct.pack("<QB", 1_700_000_000 * NS, 1), struct.pack("<QB", 5, 1)]
    unroll = unroller(Topic("/f", MESSAGE_ENCODING, layout.to_schema("bus")), "at")
    assert unroll.rows(frames).stamp_ns.tolist() == [1_700_000_000 * NS, 0]  # type: ignore[union-attr]  # an array
    assert [unroll.stamp_ns(frame) for frame in frames] == [1_700_000_000 * NS, None]
    assert unroll.no_stamp(frames[1]) == 5 and unroll.no_stamp(frames[0]) is None


def test_a_layout_is_read_back_and_newer_keys_are_ignored() -> None:
    layout = FrameLayout((FrameField("a", 3, 5, "int", "big", 2.0, -1.0, "m", {1: "x"}),), 4)
    assert read_layout(layout.to_schema("bus")) == layout
    newer = b'{"fields": [{"name": "a", "bit": 0, "bits": 8, "colour": "red"}], "checksum": {}}'
    assert read_layout(Schema("bus", "amberbox_layout", newer)).fields[0].name == "a"


@pytest.mark.parametrize(
    ("text", "why"),
    [
        ('{"fields": [{"name": "a", "bit": 0, "bits": 65}]}', "numbers have 1 to 64"),
        ('{"fields": [{"name": "a", "bit": -1, "bits": 8}]}', ">= 0"),
        ('{"fields": [{"name": "a", "bit": 99999999999999, "bits": 8}]}', "<"),
        ('{"fields": [{"name": "a", "bit": 0, "bits": 24, "kind": "float"}]}', "16, 32 or 64"),
        ('{"fields": [{"name": "a", "bit": 4, "bits": 8, "kind": "text"}]}', "with a byte"),
        ('{"fields": [{"name": "/", "bit": 4, "bits": 8}]}', "no name"),
        ('{"fields": [{"name": "a", "bit": 0, "bits": 8}, {"name": "a", "bit": 8, "bits": 8}]}',
         "twice"),
        ('{"fields": [{"name": "a", "bit": 0, "bits": 8, "when": {"field": "b", "values": [1]}}]}',
         "depends on b"),
        ('{"fields": [' + ",".join(f'{{"name":"a{n}","bit":0,"bits":8}}' for n in range(17_000))
         + "]}", "more than 16384 columns"),
        ("[" * 100_000, "cannot read the layout"),
        ("\x00", "cannot read the layout"),
    ],
)  # fmt: skip
def test_wrong_layouts_have_no_columns(text: str, why: str) -> None:
    with pytest.raises(AmberboxError, match=why):
        unroller(Topic("/f", MESSAGE_ENCODING, Schema("bus", "amberbox_layout", text.encode())))


def test_frames_go_through_files_and_plots(tmp_path: Path) -> None:
    layout = FrameLayout((FrameField("speed", 0, 16, "int", scale=0.1, unit="m/s"),), 8)
    schema = layout.to_schema("drive")
    with (tmp_path / "in.mcap").open("wb") as file:
        writer = Writer(file)
        writer.start()
        number = writer.register_schema(schema.name, schema.encoding, schema.data)
        channel = writer.register_channel("/drive", MESSAGE_ENCODING, number)
        for n in range(100):
            at = 1_700_000_000 * NS + n * 10**7
            writer.add_message(channel, at, struct.pack("<h6x", -n), at)
        writer.finish()  # type: ignore[no-untyped-call]  # has no types
    out = tmp_path / "out.mcap"
    assert main(["export", str(tmp_path / "in.mcap"), "-o", str(out)]) == 0
    with amberbox.open(out) as record:
        (column,) = record.variables("ros_drive").columns
        assert (column.unit, column.type) == ("m/s", "float64")
        table = record.query("ros_drive", ["speed"])
        assert table["speed"].tolist() == pytest.approx([-n / 10 for n in range(100)])  # type: ignore[union-attr]  # an array
    picture = tmp_path / "x.svg"
    assert main(["plot", str(out), "ros_drive", "speed", "-o", str(picture)]) == 0
    assert "m/s" in picture.read_text()
