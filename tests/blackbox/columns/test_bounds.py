"""Small definitions and messages that would expand enormously get no columns, and quickly."""

from __future__ import annotations

import struct
from pathlib import Path

import msgspec
import numpy as np
import pytest

from amberbox.blackbox.columns import UnrollError, ros_layout
from amberbox.blackbox.columns.json_messages import widen_schema
from amberbox.blackbox.columns.json_schema import EXACT_COMMENT
from amberbox.blackbox.columns.unroll import unroller
from amberbox.blackbox.store.batches import BatchOrigin, ItemStream, make_batch
from amberbox.blackbox.store.clocks import ClockTable
from amberbox.core.errors import AmberboxError
from amberbox.core.types import Schema, Topic

LINE = "\n" + "=" * 80 + "\n"


def ros(*types: str, encoding: str = "ros1") -> Topic:
    """Make a topic of types ``p/T0``, ``p/T1`` ..., each with its fields."""
    parts = [text if n == 0 else f"MSG: p/T{n}\n{text}" for n, text in enumerate(types)]
    return Topic("/t", encoding, Schema("p/T0", "ros1msg", LINE.join(parts).encode()))


def chain(field: str, depth: int) -> Topic:
    """Make a type of types of types; ``field`` is the line of a field of the next one."""
    lines = ["\n".join(field.format(n + 1).split(";")) for n in range(depth)]
    return ros(*lines, "uint8 x")


@pytest.mark.parametrize(
    ("topic", "why"),
    [
        (chain("T{0} a;T{0} b", 40), "more than 16384 columns"),
        (chain("T{0}[] a;T{0}[] b", 30), "more than 16384 columns"),
        (chain("T{0}[] a", 30), "lists in lists"),
        (ros(*[f"T{n + 1}[64] a" for n in range(9)], ""), "more than 16384 columns"),
        (ros("uint8 x\n" * 200_000), "more than 1 MB"),
        (ros("uint8[999999999999] x\nT0[] y"), "contains itself"),
    ],
    ids=["doubling", "lists", "deep", "of nothing", "long", "itself"],
)  # fmt: skip
def test_a_definition_that_means_too_much_has_no_columns(topic: Topic, why: str) -> None:
    with pytest.raises(AmberboxError, match=why):
        unroller(topic)


@pytest.mark.parametrize(
    ("definition", "message"),
    [
        ("T1[] a", struct.pack("<I", 0xFFFFFFFF)),
        ("T1[] a", struct.pack("<I", 100_000)),
        ("T1[4000000000] a", b""),
        ("T2[] a", struct.pack("<I", 1000) + struct.pack("<I", 0xFFFF) * 1000),
        ("T3[4000000000] a", bytes(100)),
        ("string[4000000000] a", bytes(100)),
    ],
)
def test_rows_without_bytes_are_not_believed(definition: str, message: bytes) -> None:
    found = unroller(ros(definition, "", "T1[] b", "uint8 c\nstring d"))
    with pytest.raises(UnrollError):
        found.rows([message])


def test_a_message_of_too_many_rows_is_told_and_others_are_rows() -> None:
    found = unroller(ros("T1[] a", "uint8 x"))
    much = struct.pack("<I", ros_layout.MOST_ROWS + 1) + bytes(ros_layout.MOST_ROWS + 1)
    little = struct.pack("<I", 3) + bytes(3)
    with pytest.raises(UnrollError) as caught:
        found.rows([little, much])
    assert caught.value.bad == (1,)
    assert found.rows([little]).children["a"].count == 3


def test_a_json_text_of_millions_of_objects_is_not_decoded() -> None:
    schema, _ = widen_schema(None, [b'{"a":[{"b":1}]}'], "json", "t")
    bomb = b'{"a":[%s{}]}' % (b"{}," * 12_000_000)
    with pytest.raises(UnrollError) as caught:
        unroller(Topic("/t", "json", schema)).rows([b'{"a":[{"b":2}]}', bomb])
    assert caught.value.bad == (1,)
    assert widen_schema(schema, [bomb], "json", "t") == (schema, (0,))


SCHEMAS = [
    b"[" * 100_000,
    msgspec.json.encode({"$comment": EXACT_COMMENT, "type": 7}),
    msgspec.json.encode({"$comment": EXACT_COMMENT, "type": [["a"]]}),
    msgspec.json.encode({"$comment": EXACT_COMMENT, "type": "object", "properties": [1]}),
    msgspec.json.encode({"$comment": EXACT_COMMENT, "type": "object", "properties": {"a": 5}}),
    msgspec.json.encode({"$comment": EXACT_COMMENT, "type": "object", "x-columns": [1, None]}),
    msgspec.json.encode(
        {"$comment": EXACT_COMMENT, "type": "object",
         "properties": {f"a{n}": {"type": "integer"} for n in range(20_000)}}
    ),
]  # fmt: skip


@pytest.mark.parametrize("data", SCHEMAS, ids=range(len(SCHEMAS)))
def test_a_schema_of_nonsense_has_no_columns_or_none_that_hurt(data: bytes) -> None:
    stream = ItemStream("t", Topic("/t", "json", Schema("t", "jsonschema", data)))
    times = np.arange(1)
    made = make_batch(BatchOrigin("main", 1, stream, ClockTable(())), times, times, [b'{"a":1}'])
    if made.batch is None:
        assert made.gaps[0].reason.startswith("undecodable: ")


def test_names_of_columns_are_bounded(tmp_path: Path) -> None:
    schema, _ = widen_schema(
        None, [msgspec.json.encode({"k" * 50_000: 1, "K" * 50_000: 2})], "json", "t"
    )
    first, second = unroller(Topic("/t", "json", schema)).schema.columns
    assert len(first.name) == 200 and len(second.name) < 210
    assert first.name.casefold() != second.name.casefold()
