"""Schemas of JSON topics in journals: viewers accept them, and they contain all types seen."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.reader import make_reader

from amberbox.blackbox.columns.json_messages import widen_schema
from amberbox.blackbox.columns.json_schema import (
    EXACT_COMMENT,
    SHAPE_KEY,
    from_schema,
    to_schema,
    viewer_form,
    viewer_schema,
)
from amberbox.blackbox.columns.unroll import unroller
from amberbox.core.types import ItemSchema, Schema, Topic
from amberbox.testing.records import T0_NS, FakeItem, FakeRun

SCALARS = st.none() | st.booleans() | st.integers(-3, 3) | st.just(0.5) | st.text("ab", max_size=2)
KEYS = st.sampled_from(["a", "b", "a/b", "a_b", ""])
VALUES = st.recursive(
    SCALARS,
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(KEYS, inner, max_size=4),
    max_leaves=12,
)


def refusals(document: Any, message: Any, path: str = "root") -> Iterator[str]:
    """Give the reasons for which Foxglove and Lichtblick refuse a channel, or a message of it."""
    if document.get("type") != "object" or not isinstance(document.get("properties"), dict):
        yield f"{path}: expected an object"
        return
    for name, inner in document["properties"].items():
        value = message.get(name) if isinstance(message, dict) else None
        yield from _refused_field(inner, value, f"{path}.{name}")


def _refused_field(field: Any, value: Any, path: str) -> Iterator[str]:
    match field.get("type"):
        case "boolean" | "number" | "integer":
            pass
        case "string":
            if field.get("contentEncoding") not in (None, "base64"):
                yield f"{path}: encoding"
        case "object":
            yield from refusals(field, value, path)
        case "array":
            yield from _refused_items(field.get("items"), value, path)
        case other:
            yield f"{path}: type {other}"


def _refused_items(items: Any, value: Any, path: str) -> Iterator[str]:
    if not isinstance(items, dict) or "contentEncoding" in items:
        yield f"{path}: items {items}"
    elif items.get("type") == "object":
        for entry in value or [{}]:
            if entry is None and items["properties"]:
                yield f"{path}: a null among objects"
            yield from refusals(items, entry, path)
    elif items.get("type") not in ("boolean", "number", "integer", "string"):
        yield f"{path}: items {items}"


def learn(*values: Any) -> Schema:
    schema, bad = widen_schema(None, [json.dumps(value).encode() for value in values], "json", "t")
    assert bad == ()
    return schema


def columns(schema: Schema) -> ItemSchema:
    return unroller(Topic("/t", "json", schema)).schema


@settings(max_examples=200)
@given(st.lists(VALUES, min_size=1, max_size=5))
def test_viewers_take_whatever_was_inferred(values: list[Any]) -> None:
    document = json.loads(learn(*values).data)
    assert [reason for value in values for reason in refusals(document, value)] == []


@settings(max_examples=200)
@given(st.lists(VALUES, min_size=1, max_size=5))
def test_a_schema_tells_all_that_was_seen(values: list[Any]) -> None:
    schema = learn(*values)
    assert to_schema(from_schema(schema), "t") == schema
    messages = [json.dumps(value).encode() for value in values]
    assert widen_schema(schema, messages, "json", "t")[0] is schema


def test_plain_topics_are_written_plainly() -> None:
    document = json.loads(learn({"x": 1.5, "scan": [1, 2], "parts": [{"id": "a"}]}).data)
    assert document == {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        "$comment": EXACT_COMMENT,
        "title": "t",
        "type": "object",
        "properties": {
            "x": {"type": "number"},
            "scan": {"type": "array", "items": {"type": "integer"}},
            "parts": {
                "type": "array",
                "items": {"type": "object", "properties": {"id": {"type": "string"}}},
            },
        },
    }


@pytest.mark.parametrize(
    "value",
    [{"x": None}, {"x": []}, {"x": [1, None]}, {"x": [[1]]}, {"x": [{"y": {"z": 1}}, None]}, 5],
)
def test_what_viewers_cannot_be_told_is_said_beside(value: Any) -> None:
    assert SHAPE_KEY in json.loads(learn(value).data)


OLD = {
    "$comment": EXACT_COMMENT,
    "type": ["object", "null"],
    "properties": {
        "x": {"type": ["number", "null"]},
        "mixed": {"type": ["boolean", "string", "null"]},
        "scan": {"type": ["array", "null"], "items": {"type": ["number", "null"]}},
        "deep": {"type": ["object", "null"], "properties": {"y": {"type": ["integer", "null"]}}},
        "none": {"type": ["null"]},
    },
    "x-columns": ["mixed", "x", "scan", "deep/y"],
}


def test_schemas_of_older_journals_have_the_same_columns() -> None:
    old = Schema("t", "jsonschema", json.dumps(OLD).encode())
    assert [(column.name, column.type) for column in columns(old).columns] == [
        ("x", "float64"),
        ("mixed", "string"),
        ("scan", "list<float64>"),
        ("deep_y", "int64"),
    ]
    exported = viewer_schema(old)
    assert exported is not None and columns(exported) == columns(old)
    assert list(refusals(json.loads(exported.data), {})) == []
    message = b'{"x": null, "mixed": true, "scan": [1, null], "deep": {"y": 3}}'
    assert widen_schema(old, [message], "json", "t")[0] is old


def test_a_journal_opens_as_it_is(tmp_path: Path) -> None:
    run = FakeRun(tmp_path / "store")
    odd = {"f": 1.5, "mixed": 1, "list": [1.5, None], "empty": [], "deep": {"a": True, "b": [[1]]}}
    item = FakeItem("odd", [odd, {"mixed": "text", "units": [{"id": 1}]}])
    run.write([(T0_NS, item, odd)])
    run.close()
    (journal,) = (tmp_path / "store" / "journal").glob("*.mcap")
    with journal.open("rb") as file:
        read = [(s, m) for s, c, m in make_reader(file).iter_messages() if c.topic == "/odd"]
    ((schema, message),) = read
    assert schema is not None and schema.encoding == "jsonschema"
    document = json.loads(schema.data)
    assert list(refusals(document, json.loads(message.data))) == []
    assert document["properties"]["f"] == {"type": "number"}


def test_binary_beside_text_is_not_promised_to_be_base64() -> None:
    assert viewer_form({"type": "string", "contentEncoding": "base64", "x-also-text": True}) is None


def test_viewers_stop_at_a_null_among_objects() -> None:
    inner = {"type": ["object", "null"], "properties": {"x": {"type": "number"}}}
    assert viewer_form({"type": "array", "items": inner}) is None
    plain = inner | {"type": "object"}
    assert viewer_form({"type": "array", "items": plain}) == {"type": "array", "items": plain}
