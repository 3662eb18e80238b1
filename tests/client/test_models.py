"""The client's models and the server's OpenAPI: each field exists, and the types match."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import msgspec
import pytest

from amberbox.client import models
from amberbox.client.models import Answer
from tests.server.house import house

Schema = Mapping[str, Any]

MODELS = [
    kind
    for module in (models, models)
    for kind in vars(module).values()
    if isinstance(kind, type) and issubclass(kind, Answer) and kind is not Answer
    if kind.__module__ == module.__name__
]


@pytest.fixture(scope="module")
def served(tmp_path_factory: pytest.TempPathFactory) -> Schema:
    """The schemas of the server, by name."""
    with house(tmp_path_factory.mktemp("house"), shared=True) as home:
        return dict(home.app.openapi()["components"]["schemas"])


@pytest.mark.parametrize("kind", MODELS, ids=lambda kind: kind.__name__)
def test_the_server_says_what_the_client_reads(served: Schema, kind: type[Answer]) -> None:
    assert kind.__name__ in served, "the server has no answer of this name"
    _, expected = msgspec.json.schema_components([kind])
    said, own = served[kind.__name__], expected[kind.__name__]
    assert set(own["properties"]) <= set(said["properties"])
    assert set(own.get("required", ())) <= set(said.get("required", ())), (
        "the client cannot do without"
    )
    for name, schema in own["properties"].items():
        why = misfit(said["properties"][name], served, schema, expected)
        assert not why, f"{name}: {why}"


def misfit(said: Schema, served: Schema, own: Schema, expected: Schema) -> str:
    """Return the part of a server's answer that the client does not accept; empty if there
    is none.
    """
    taken = alternatives(own, expected)
    for one in alternatives(said, served):
        reasons = [_misfit(one, served, other, expected) for other in taken]
        if all(reasons):
            return reasons[0]
    return ""


def alternatives(schema: Schema, known: Schema) -> list[Schema]:
    """Return the types that a schema lets through; references to structures stay."""
    if "$ref" in schema:
        found = known[schema["$ref"].rpartition("/")[2]]
        return [schema] if "properties" in found else alternatives(found, known)
    if "anyOf" in schema:
        return [one for inner in schema["anyOf"] for one in alternatives(inner, known)]
    kinds = schema.get("type")
    return [{**schema, "type": one} for one in kinds] if isinstance(kinds, list) else [schema]


def _misfit(said: Schema, served: Schema, own: Schema, expected: Schema) -> str:
    if "$ref" in own or "$ref" in said:
        names = [one.get("$ref", "nothing").rpartition("/")[2] for one in (said, own)]
        return "" if names[0] == names[1] else f"{names[0]} is no {names[1]}"
    kinds = said.get("type"), own.get("type")
    if kinds[1] is None or kinds == ("integer", "number"):
        return ""
    if kinds[0] != kinds[1]:
        return f"{kinds[0]} is no {kinds[1]}"
    for inner in ("items", "additionalProperties"):
        if isinstance(own.get(inner), Mapping):
            rest = said.get(inner)
            return misfit(rest if isinstance(rest, Mapping) else {}, served, own[inner], expected)
    return ""


@pytest.mark.parametrize(
    ("said", "own", "why"),
    [
        ({"type": "integer"}, {"type": "number"}, ""),
        ({"type": "number"}, {"type": "integer"}, "number is no integer"),
        ({"anyOf": [{"type": "string"}, {"type": "null"}]}, {"type": "string"},
         "null is no string"),
        ({"type": "array", "items": {"type": "string"}},
         {"type": "array", "items": {"type": "integer"}}, "string is no integer"),
        ({"type": "object", "additionalProperties": True},
         {"type": "object", "additionalProperties": {"type": "string"}}, "None is no string"),
        ({"$ref": "#/Role"}, {"type": "string"}, ""),
        ({"$ref": "#/Item"}, {"$ref": "#/Robot"}, "Item is no Robot"),
    ],
)  # fmt: skip
def test_what_does_not_fit_is_told(said: Schema, own: Schema, why: str) -> None:
    structure: Schema = {"properties": {}}
    known = {"Role": {"type": "string"}, "Item": structure, "Robot": structure}
    assert misfit(said, known, own, known) == why
