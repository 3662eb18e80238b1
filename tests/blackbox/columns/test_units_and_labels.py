"""Units and labels in a sender's schema are attached to the columns."""

from __future__ import annotations

import json
from typing import Any

import pytest

from amberbox.blackbox.columns.json_messages import widen_schema
from amberbox.blackbox.columns.json_schema import NOTES_KEY, ValueNote, notes_of, viewer_schema
from amberbox.blackbox.columns.unroll import unroller
from amberbox.core.types import Column, ItemSchema, Schema, Topic

STATES = {"0": "off", "3": "on"}
TOLD = {
    "type": "object",
    "properties": {
        "pose": {"type": "object", "properties": {"x": {"type": "number", "unit": "m"}}},
        "state": {"type": "integer", "labels": STATES},
        "scan": {"type": "array", "items": {"type": "number", "unit": "m"}},
        "cells": {
            "type": "array",
            "items": {"type": "object", "properties": {"u": {"type": "number", "unit": "V"}}},
        },
        "name": {"type": "string", "unit": "m"},
        "late": {"type": "number", "unit": "s"},
    },
}
MESSAGE = {"pose": {"x": 1.5}, "state": 3, "scan": [1.5], "cells": [{"u": 3.7}], "name": "a"}


def sender_schema(document: Any) -> Schema:
    return Schema("sender/t", "jsonschema", json.dumps(document).encode())


def learn(before: Schema | None, *values: Any, said: Any = None) -> Schema:
    messages = [json.dumps(value).encode() for value in values]
    schema, bad = widen_schema(
        before, messages, "json", "t", notes_of(sender_schema(said)) if said else None
    )
    assert bad == ()
    return schema


def table(schema: Schema) -> ItemSchema:
    return unroller(Topic("/t", "json", schema)).schema


def columns(schema: Schema) -> dict[str, Column]:
    found = table(schema)
    return {column.path: column for column in (*found.columns, *found.children["cells"].columns)}


def test_columns_have_the_unit_and_the_names_that_the_sender_tells() -> None:
    found = columns(learn(None, MESSAGE, said=TOLD))
    assert {path: column.unit for path, column in found.items()} == {
        "pose/x": "m", "state": "", "scan": "m", "u": "V", "name": "",
    }  # fmt: skip
    assert found["state"].labels == {0: "off", 3: "on"}
    assert found["pose/x"].labels == {}


def test_what_comes_later_has_its_unit_too() -> None:
    schema = learn(learn(None, MESSAGE, said=TOLD), MESSAGE | {"late": 0.5})
    assert columns(schema)["late"].unit == "s"
    assert columns(schema)["pose/x"].unit == "m"


def test_types_are_those_that_came_and_codes_that_are_no_whole_numbers_have_no_names() -> None:
    found = columns(learn(None, MESSAGE | {"state": 0.5, "late": "soon"}, said=TOLD))
    assert (found["state"].type, found["state"].labels) == ("float64", {})
    assert (found["late"].type, found["late"].unit) == ("string", "")


def test_a_schema_that_tells_nothing_is_written_as_ever() -> None:
    assert learn(None, MESSAGE, said={"type": "object"}) == learn(None, MESSAGE)
    assert NOTES_KEY not in json.loads(learn(None, MESSAGE).data)


def test_an_export_keeps_them_and_an_import_reads_them_again() -> None:
    exported = viewer_schema(learn(None, MESSAGE, said=TOLD))
    assert exported is not None
    again, _ = widen_schema(None, [json.dumps(MESSAGE).encode()], "json", "t", notes_of(exported))
    assert columns(again) == columns(learn(None, MESSAGE, said=TOLD))


@pytest.mark.parametrize(
    "document",
    [
        b"no json", b"[1]", b'{"properties": 3}', b'{"properties": {"a": []}}',
        b'{"properties": {"a": {"unit": 3, "labels": {"x": "y", "1": 2, "1.5": "z"}}}}',
        b'{"properties": {"a": {"labels": [1]}}}', b'{"x-notes": {"a": "m", "b": {"unit": 1}}}',
        b'{"a":' * 100_000,
    ],
)  # fmt: skip
def test_what_cannot_be_understood_says_nothing(document: bytes) -> None:
    assert notes_of(Schema("t", "jsonschema", document)) == {}


def test_schemas_of_other_kinds_say_nothing() -> None:
    assert notes_of(None) == {}
    assert notes_of(Schema("t", "ros2msg", json.dumps(TOLD).encode())) == {}


def test_a_message_that_is_a_list_has_a_unit() -> None:
    assert notes_of(sender_schema({"type": "array", "items": {"unit": "m"}})) == {
        "value": ValueNote("m")
    }
