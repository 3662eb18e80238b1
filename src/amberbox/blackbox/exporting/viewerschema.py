"""JSON Schemas as viewers read them, whoever wrote them."""

from __future__ import annotations

import msgspec

from amberbox.blackbox.unroll.jsonschema import from_schema, is_ours, to_schema
from amberbox.blackbox.unroll.notes import notes_of
from amberbox.blackbox.unroll.viewerform import viewer_form
from amberbox.core.types import Schema


def viewer_schema(schema: Schema | None) -> Schema | None:
    """Return a schema that Foxglove and its kin read, None where there is none to be had.

    Those of our journals are such already; the ones of older journals become so.
    """
    if schema is None or schema.encoding != "jsonschema":
        return schema
    try:
        document = msgspec.json.decode(schema.data)
    except msgspec.DecodeError:
        return None
    if is_ours(document):
        return to_schema(from_schema(schema), schema.name, notes_of(schema))
    plain = viewer_form(document)
    if plain is None or plain["type"] != "object":
        return None
    head = {key: document[key] for key in ("$schema", "title") if key in document}
    return Schema(schema.name, schema.encoding, msgspec.json.encode(head | plain))
