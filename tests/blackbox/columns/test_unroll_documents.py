"""JSON and MessagePack topics: schemas that widen, and rows under them."""

from __future__ import annotations

import json
import math
import random
import struct
from contextlib import suppress
from typing import Any

import msgspec
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from amberbox.blackbox.columns import Unroller, UnrollError
from amberbox.blackbox.columns.json_messages import widen_schema
from amberbox.blackbox.columns.json_schema import (
    DEEPEST,
    MOST_COLUMNS,
    MOST_PROPERTIES,
    from_schema,
    to_schema,
)
from amberbox.blackbox.columns.unroll import unroller
from amberbox.core.errors import AmberboxError
from amberbox.core.types import ItemSchema, Ragged, Rows, Schema, Topic
from tests.fuzzing import examples, fuzz

NS = 1_000_000_000
KEYS = st.sampled_from(["a", "b", "A", "a/b", "a_b", "seq", "~", ""])
SCALARS = (
    st.none()
    | st.booleans()
    | st.integers(-3, 3)
    | st.integers(2**62, 2**64 - 1)
    | st.floats(allow_nan=False, allow_infinity=False)
    | st.text("ab1", max_size=3)
)
VALUES = st.recursive(
    SCALARS,
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(KEYS, inner, max_size=4),
    max_leaves=12,
)
MESSAGES = st.lists(st.dictionaries(KEYS, VALUES, max_size=4), max_size=6)
ENCODINGS = st.sampled_from(["json", "msgpack"])


def encode(value: Any, encoding: str) -> bytes:
    return json.dumps(value).encode() if encoding == "json" else msgspec.msgpack.encode(value)


def learn(values: list[Any], encoding: str = "json") -> tuple[Schema, Unroller, list[bytes]]:
    messages = [encode(value, encoding) for value in values]
    schema, bad = widen_schema(None, messages, encoding, "task")
    assert bad == ()
    return schema, unroller(Topic("/t", encoding, schema)), messages


def kinds(schema: ItemSchema) -> dict[str, Any]:
    own: dict[str, Any] = {column.path: column.type for column in schema.columns}
    return own | {path: kinds(child) for path, child in schema.children.items()}


def cells(rows: Rows, name: str) -> list[Any]:
    column = rows.columns[name]
    if isinstance(column, Ragged):
        return [column[row].tolist() for row in range(rows.count)]
    return list(column.tolist())


def test_the_paper_s_kind_of_message() -> None:
    values = [{"header": {"type": "TASK", "timestamp": 1.5e9}, "payload": {"x": 1, "ok": True}}]
    schema, task, messages = learn(values)
    assert schema.name == "task" and schema.encoding == "jsonschema"
    document = json.loads(schema.data)
    assert document["$schema"] == "https://json-schema.org/draft/2020-12/schema"
    assert document["properties"]["payload"]["properties"]["x"] == {"type": "integer"}
    assert kinds(task.schema) == {
        "header/type": "string",
        "header/timestamp": "float64",
        "payload/x": "int64",
        "payload/ok": "bool",
    }
    assert [column.name for column in task.schema.columns][2] == "payload_x"
    assert task.stamp_ns(messages[0]) == 1_500_000_000 * NS


@pytest.mark.parametrize(
    ("seen", "kind", "expected"),
    [
        ([1, None, 3], "int64", [1, None, 3]),
        ([1, 2.5], "float64", [1.0, 2.5]),
        ([1, 2**63], "float64", [1.0, float(2**63)]),
        ([True, None], "bool", [True, None]),
        ([True, 1], "string", ["true", "1"]),
        ([1, "a", 0.5, None], "string", ["1", "a", "0.5", None]),
        ([1, [2]], "string", ["1", "[2]"]),
        ([{"y": 1}, "a"], "string", ['{"y":1}', "a"]),
        ([[1, 2], None, []], "list<int64>", [[1, 2], [], []]),
        ([[1, 2.5]], "list<float64>", [[1.0, 2.5]]),
        ([["a", None]], "list<string>", [["a", None]]),
        ([["a", 1]], "list<string>", [["a", "1"]]),
        ([[True, None]], "list<string>", [["true", None]]),
        ([[[1]], [2]], "string", ["[[1]]", "[2]"]),
        ([[1, {"y": 2}]], "string", ['[1,{"y":2}]']),
    ],
)
@pytest.mark.parametrize("encoding", ["json", "msgpack"])
def test_columns_of_values(seen: list[Any], kind: str, expected: list[Any], encoding: str) -> None:
    _, task, messages = learn([{"x": value} for value in seen], encoding)
    assert kinds(task.schema) == {"x": kind}
    assert cells(task.rows(messages), "x") == expected


def test_a_null_among_numbers_is_nan() -> None:
    _, scan, messages = learn([{"ranges": [1, None]}])
    assert kinds(scan.schema) == {"ranges": "list<float64>"}
    first, second = cells(scan.rows(messages), "ranges")[0]
    assert first == 1.0 and math.isnan(second)


@pytest.mark.parametrize("values", [[], [{}], [{"x": None}], [{"x": []}], [{"x": {}}]])
def test_what_says_nothing_has_no_column_yet(values: list[Any]) -> None:
    _, task, messages = learn(values)
    rows = task.rows(messages)
    assert task.schema.columns == () and rows.columns == {} and rows.count == len(values)


def test_lists_of_objects_are_child_tables() -> None:
    value = {"parts": [{"id": 1, "subs": [{"v": 1}, {"v": 2}]}, {"id": 2, "subs": []}, None]}
    _, task, messages = learn([value, {"parts": None}, value])
    assert kinds(task.schema) == {"parts": {"id": "int64", "subs": {"v": "int64"}}}
    parts = task.rows(messages).children["parts"]
    assert parts.parent_row is not None and parts.parent_row.tolist() == [0, 0, 0, 2, 2, 2]
    assert parts.index is not None and parts.index.tolist() == [0, 1, 2] * 2
    assert cells(parts, "id") == [1, 2, None] * 2
    subs = parts.children["subs"]
    assert subs.parent_row is not None and subs.parent_row.tolist() == [0, 0, 3, 3]


@pytest.mark.parametrize(
    ("values", "expected"),
    [([1, 2.5], [1.0, 2.5]), (["a"], ["a"]), ([[1, 2]], [[1, 2]]), ([None, True], [None, True])],
)
def test_messages_that_are_no_objects_are_one_column(
    values: list[Any], expected: list[Any]
) -> None:
    _, topic, messages = learn(values)
    assert cells(topic.rows(messages), "value") == expected


def test_a_list_of_objects_at_the_top_is_a_child_table() -> None:
    _, topic, messages = learn([[{"x": 1}, {"x": 2}]])
    assert cells(topic.rows(messages).children["value"], "x") == [1, 2]


def test_names_stay_when_paths_come_later() -> None:
    first, _, old = learn([{"a": {"x": 1}, "a_b": 2}])
    second, bad = widen_schema(first, [b'{"a": {"b": 3}}'], "json", "other")
    assert bad == () and second.name == "task"
    task = unroller(Topic("/t", "json", second))
    names = {column.path: column.name for column in task.schema.columns}
    assert names["a_b"] == "a_b" and names["a/b"].startswith("a_b_")
    assert widen_schema(second, old, "json", "other")[0] is second
    third, _ = widen_schema(second, [b'{"c": 3}'], "json", "other")
    later = unroller(Topic("/t", "json", third)).schema
    assert names.items() <= {column.path: column.name for column in later.columns}.items()


@pytest.mark.parametrize("encoding", ["json", "msgpack"])
def test_messages_that_say_nothing_new_are_recognised_in_c(
    encoding: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    values = [
        {"i": 1, "f": 1.5, "s": "a", "l": [1, None], "m": [[1], []], "e": [], "n": None},
        {"o": {"x": [{"y": True}, None]}, "mixed": 1, "by_id": {f"k{n}": n for n in range(300)}},
        {"mixed": {"a": [1, "b", {"c": 2}]}},
    ]
    schema, _, messages = learn(values, encoding)
    monkeypatch.delattr("amberbox.blackbox.columns.json_messages.decode_plain")
    assert widen_schema(schema, messages, encoding, "task")[0] is schema


def test_objects_used_as_maps_become_text() -> None:
    values = [{"by_id": {f"id{n}": n}} for n in range(MOST_PROPERTIES + 1)]
    _, task, messages = learn(values)
    assert kinds(task.schema) == {"by_id": "string"}
    assert cells(task.rows(messages), "by_id")[7] == '{"id7":7}'


@pytest.mark.parametrize("key", ['a"b', "a\\b", "a\nb", "\0"])
def test_objects_with_keys_that_cannot_be_columns_become_text(key: str) -> None:
    _, task, messages = learn([{"o": {"x": 1}, "n": 2}, {"o": {key: 1}, "n": 3}])
    assert kinds(task.schema) == {"o": "string", "n": "int64"}
    assert [json.loads(cell) for cell in cells(task.rows(messages), "o")] == [{"x": 1}, {key: 1}]


def test_messages_with_keys_that_cannot_be_columns_become_text() -> None:
    _, task, messages = learn([{'a"b': 1}])
    (column,) = task.schema.columns
    assert json.loads(cells(task.rows(messages), column.name)[0]) == {'a"b': 1}


def test_deep_values_become_text() -> None:
    value: Any = 1
    for _ in range(DEEPEST + 4):
        value = {"d": value}
    _, task, messages = learn([value, {"l": [[[[[1]]]]]}])
    deep, lists = task.schema.columns
    assert deep.path == "/".join(["d"] * DEEPEST) and deep.type == "string"
    assert cells(task.rows(messages), deep.name)[0].startswith('{"d":{"d":')
    assert cells(task.rows(messages), lists.name)[1] == "[[[[[1]]]]]"


def test_keys_with_slashes_are_escaped() -> None:
    _, task, messages = learn([{"a/b": 1, "a": {"b": 2}, "~": 3, "": 4}])
    assert kinds(task.schema).keys() == {"a~1b", "a/b", "~0", "~2"}
    values = {c.path: cells(task.rows(messages), c.name)[0] for c in task.schema.columns}
    assert values == {"a~1b": 1, "a/b": 2, "~0": 3, "~2": 4}


def test_schemas_of_others_are_not_relied_on() -> None:
    foreign = Schema("Foreign", "jsonschema", b'{"type":"object","properties":{"x":{"$ref":"?"}}}')
    schema, bad = widen_schema(foreign, [b'{"x": 1}'], "json", "t")
    assert bad == () and schema.name == "Foreign"
    assert kinds(unroller(Topic("/t", "json", schema)).schema) == {"x": "int64"}
    broken = Schema("Broken", "jsonschema", b"{")
    assert widen_schema(broken, [b'{"x": 1}'], "json", "t")[0].data.startswith(b'{"$schema"')


@settings(max_examples=150)
@given(MESSAGES, ENCODINGS, st.randoms(use_true_random=False), st.integers(1, 3))
def test_widening_does_not_depend_on_order(
    values: list[Any], encoding: str, order: random.Random, portion: int
) -> None:
    schema, task, messages = learn(values, encoding)
    shuffled = order.sample(messages, len(messages))
    other: Schema | None = None
    for start in range(0, len(shuffled), portion):
        other, _ = widen_schema(other, shuffled[start : start + portion], encoding, "task")
    if other is not None:
        assert kinds(unroller(Topic("/t", encoding, other)).schema) == kinds(task.schema)
        assert widen_schema(other, messages, encoding, "task") == (other, ())
        assert widen_schema(other, messages, encoding, "task")[0] is other
    assert widen_schema(schema, shuffled, encoding, "task")[0] is schema


@settings(max_examples=150)
@given(MESSAGES, ENCODINGS)
def test_every_message_seen_unrolls_to_its_values(values: list[Any], encoding: str) -> None:
    _, task, messages = learn(values, encoding)
    rows = task.rows(messages)
    for number, value in enumerate(values):
        check_row(value, rows, number, task.schema)


def check_row(value: Any, rows: Rows, row: int, schema: ItemSchema) -> None:
    for column in schema.columns:
        expected = follow(value, column.path)
        cell = cells(rows, column.name)[row]
        if column.type.startswith("list<"):
            assert len(cell) == len(expected or [])
        elif expected is None or column.type in ("bool", "int64"):
            assert cell == expected
        elif column.type == "float64":
            assert cell == float(expected)
        elif isinstance(expected, str):
            assert cell == expected
        else:
            assert json.loads(cell) == expected
    for path, child_schema in schema.children.items():
        child = rows.children[path]
        assert child.parent_row is not None
        items = follow(value, path) or []
        places = np.flatnonzero(child.parent_row == row)
        assert len(places) == len(items)
        for place, item in zip(places.tolist(), items, strict=True):
            check_row(item, child, place, child_schema)


def follow(value: Any, path: str) -> Any:
    for part in path.split("/"):
        key = "" if part == "~2" else part.replace("~1", "/").replace("~0", "~")
        value = value.get(key) if isinstance(value, dict) else None
    return value


@settings(max_examples=100)
@given(st.binary(max_size=12) | VALUES.map(lambda v: json.dumps(v).encode()[:-1]), ENCODINGS)
def test_any_bytes_are_a_value_or_named_malformed(message: bytes, encoding: str) -> None:
    good = encode({"x": 1}, encoding)
    schema, bad = widen_schema(None, [good, message, good], encoding, "t")
    assert bad in ((), (1,))
    task = unroller(Topic("/t", encoding, schema))
    if bad:
        with pytest.raises(UnrollError) as caught:
            task.rows([good, message, good])
        assert caught.value.bad == bad
    assert task.rows([good, good] if bad else [good, message, good]).count == 3 - len(bad)


@pytest.mark.parametrize(
    "message",
    [
        b"",
        b"{",
        b"{}x",
        b'"\xff"',
        b"[" * 200_000 + b"]" * 200_000,
    ],
)
def test_malformed_json_is_named_and_changes_nothing(message: bytes) -> None:
    schema, _, good = learn([{"x": 1}])
    assert widen_schema(schema, [*good, message], "json", "t") == (schema, (1,))
    first, bad = widen_schema(None, [message], "json", "t")
    assert bad == (0,) and first == widen_schema(None, [], "json", "t")[0]


@pytest.mark.parametrize(
    ("message", "expected"),
    [
        (b'{"x": 1e309}', math.inf),
        (b'{"x": -1e400}', -math.inf),
        (b'{"x": 1%s}' % (b"0" * 400), math.inf),
        (b'{"x": -1%s}' % (b"0" * 6000), -math.inf),
        (b'{"x": 1%s}' % (b"0" * 305), 1e305),
    ],
)
def test_numbers_beyond_all_floats_are_infinite(message: bytes, expected: float) -> None:
    schema, _, _ = learn([{"x": 1}])
    widened, bad = widen_schema(schema, [message], "json", "t")
    assert bad == ()
    rows = unroller(Topic("/t", "json", widened)).rows([message, b'{"x": 2}'])
    assert cells(rows, "x") == [expected, 2.0]


def test_half_surrogates_become_the_character_for_what_is_none() -> None:
    messages = [b'{"a": "x\\ud800y", "\\udc00k": [1e999]}', b'{"a": "\\ud83d\\ude00"}']
    schema, bad = widen_schema(None, messages, "json", "t")
    assert bad == ()
    table = unroller(Topic("/t", "json", schema))
    rows = table.rows(messages)
    assert cells(rows, "a") == ["x\ufffdy", "\U0001f600"]
    assert [column.path for column in table.schema.columns] == ["a", "\ufffdk"]


def test_what_is_nested_too_deep_is_text_or_malformed_never_an_error() -> None:
    schema, bad = widen_schema(None, [b'{"a": {"b": 1}}'], "json", "t")
    for depth in (20, 300, 900, 5000, 100_000):
        for open_, close in ((b"[", b"]"), (b'{"k":', b"}")):
            message = b'{"a": {"b": %s1%s}}' % (open_ * depth, close * depth)
            schema, bad = widen_schema(schema, [message], "json", "t")
            with suppress(UnrollError):
                rows = unroller(Topic("/t", "json", schema)).rows([message])
                assert not bad and rows.count == 1


def test_no_object_gets_further_keys_once_it_is_closed() -> None:
    schema, _ = widen_schema(None, [b'{"a": {"x": 1}, "n": 0}'], "json", "t")
    more = [b'{"a": {"x": 1.5, "y": 2}, "z": 3}', b'{"n": {"u": 1}}', b'{"n": {"w": 2}}']
    for message in more:
        schema, bad = widen_schema(schema, [message], "json", "t", closes=True)
        assert bad == ()
    assert widen_schema(schema, [b'{"q": 1, "a": {"v": []}}'], "json", "t") == (schema, ())
    assert from_schema(to_schema(from_schema(schema), "t")) == from_schema(schema)
    rows = unroller(Topic("/t", "json", schema)).rows([b'{"a": {"x": 1, "y": 7}, "z": 3, "n": 4}'])
    assert cells(rows, "a_x") == [1.0]
    assert "a_y" not in rows.columns and "z" not in rows.columns


def test_a_message_with_very_many_places_has_a_bounded_schema() -> None:
    value = {f"o{n}": {f"k{m}": {"v": m} for m in range(80)} for n in range(80)}
    message = json.dumps(value).encode()
    schema, bad = widen_schema(None, [message], "json", "t")
    table = unroller(Topic("/t", "json", schema))
    assert bad == () and 80 <= len(table.schema.columns) <= MOST_COLUMNS
    assert json.loads(cells(table.rows([message]), "o7")[0]) == value["o7"]
    assert widen_schema(schema, [message], "json", "t")[0] is schema


@fuzz
@settings(max_examples=examples(60))
@given(st.binary(max_size=300), st.sampled_from(["json", "msgpack"]))
def test_random_bytes_are_rows_or_malformed(message: bytes, encoding: str) -> None:
    good = b'{"x": 1}' if encoding == "json" else msgspec.msgpack.encode({"x": 1})
    schema, bad = widen_schema(None, [good, message], encoding, "t")
    table = unroller(Topic("/t", encoding, schema))
    assert table.stamp_ns(message) is None or table.no_stamp(message) is None
    if bad:
        with suppress(UnrollError):  # a decoder with less to look for may be content
            table.rows([message])
    else:
        assert table.rows([good, message]).count == 2


def test_python_s_nan_is_read() -> None:
    message = b'{"x": NaN, "y": [Infinity, 1], "z": {"t": -Infinity}}'
    schema, bad = widen_schema(None, [message], "json", "t")
    assert bad == () and widen_schema(schema, [message], "json", "t")[0] is schema
    rows = unroller(Topic("/t", "json", schema)).rows([message])
    assert math.isnan(cells(rows, "x")[0]) and cells(rows, "z_t") == [-math.inf]
    assert cells(rows, "y") == [[math.inf, 1.0]]


def test_rows_under_an_older_schema_name_what_does_not_fit() -> None:
    schema, task, good = learn([{"x": 1, "s": "a", "l": [1], "n": None}])
    for news in ({"x": 1.5}, {"x": "1"}, {"y": 1}, {"s": 1}, {"l": [1.5]}, {"l": 1}, {"n": 1}, 3):
        message = encode(news, "json")
        with pytest.raises(UnrollError) as caught:
            task.rows([good[0], message])
        assert caught.value.bad == (1,)
        assert widen_schema(schema, [message], "json", "t")[0] is not schema


def test_what_only_msgpack_has() -> None:
    moment = msgspec.msgpack.Ext(7, b"\1\2")
    values = [{"raw": b"\1\2", "mixed": "a", 5: 1, "ext": moment}, {"raw": None, "mixed": b"\1"}]
    _, task, messages = learn(values, "msgpack")
    assert kinds(task.schema) == {"raw": "binary", "mixed": "string", "5": "int64", "ext": "binary"}
    rows = task.rows(messages)
    assert cells(rows, "raw") == [b"\1\2", None] and cells(rows, "mixed") == ["a", "AQ=="]
    assert cells(rows, "ext") == [b"\1\2", None]


def test_times_of_msgpack_are_text() -> None:
    timestamp = b"\x81\xa5stamp\xd6\xff" + struct.pack(">I", 1_500_000_000)
    schema, _ = widen_schema(None, [timestamp], "msgpack", "t")
    task = unroller(Topic("/t", "msgpack", schema))
    assert cells(task.rows([timestamp]), "stamp") == ["2017-07-14T02:40:00Z"]
    assert task.stamp_ns(timestamp) == 1_500_000_000 * NS


@pytest.mark.parametrize(
    ("stamp", "expected"),
    [
        (1_500_000_000, 1_500_000_000 * NS),
        (1_500_000_000.25, 1_500_000_000 * NS + NS // 4),
        (1_500_000_000_123, 1_500_000_000_123_000_000),
        (1_500_000_000_123_456, 1_500_000_000_123_456_000),
        (1_500_000_000_123_456_789, 1_500_000_000_123_456_789),
        (12.5, None),
        (5, None),
        ("5", None),
        (99_999_999, None),
        (100_000_000, 100_000_000 * NS),
        ({"secs": 5, "nsecs": 0}, 5 * NS),
        ("2017-07-14T02:40:00.123456789Z", 1_500_000_000_123_456_789),
        ("2017-07-14T04:40:00+02:00", 1_500_000_000 * NS),
        ({"secs": 1_500_000_000, "nsecs": 7}, 1_500_000_000 * NS + 7),
        ({"sec": 1_500_000_000, "nanosec": 7}, 1_500_000_000 * NS + 7),
        (0, None),
        (-1, None),
        ("soon", None),
        ("2017-99-99T00:00:00Z", None),
        (True, None),
        (None, None),
        ({"secs": "1"}, None),
        (2**63 - 1 + 10**4, None),
    ],
)
def test_stamps_as_senders_write_them(stamp: Any, expected: int | None) -> None:
    usual = {"stamp": 1, "header": {"stamp": 1_600_000_000}}
    values = [usual, {"stamp": 5, "header": {"stamp": stamp}}]
    _, task, messages = learn(values)
    assert task.schema.stamp == "header/stamp"
    assert task.stamp_ns(messages[1]) == expected
    stamps = task.rows(messages).stamp_ns
    assert stamps is not None and stamps.tolist() == [1_600_000_000 * NS, expected or 0]


def test_which_stamp_counts() -> None:
    value = {"t": {"at": 10**9 + 3}, "stamp": 10**9 + 1, "timestamp": 10**9 + 2}
    schema, task, messages = learn([value])
    topic = Topic("/t", "json", schema)
    assert task.schema.stamp == "stamp" and task.stamp_ns(messages[0]) == (10**9 + 1) * NS
    assert unroller(topic, "t.at").stamp_ns(messages[0]) == (10**9 + 3) * NS
    assert unroller(topic, "").stamp_ns(messages[0]) is None
    assert unroller(topic, "").rows(messages).stamp_ns is None
    assert unroller(topic, "not/seen/yet").schema.stamp == ""
    assert task.stamp_ns(b"?") is None and task.stamp_ns(b"[1]") is None
    flags, _, _ = learn([{"stamp": True}])
    assert unroller(Topic("/t", "json", flags)).schema.stamp == ""


def test_topics_that_cannot_be_unrolled_say_so() -> None:
    with pytest.raises(AmberboxError, match="has no schema"):
        unroller(Topic("/t", "json"))
    with pytest.raises(AmberboxError, match="'flatbuffer' cannot be unrolled"):
        unroller(Topic("/t", "flatbuffer", Schema("T", "flatbuffer", b"")))
