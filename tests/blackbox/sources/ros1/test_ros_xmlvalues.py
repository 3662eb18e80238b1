"""XML-RPC answers read by us are what the standard library reads."""

from __future__ import annotations

import xmlrpc.client
from contextlib import suppress
from typing import Any
from xml.etree.ElementTree import ParseError

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from amberbox.blackbox.sources.ros1.master import DEEPEST, MOST_BYTES, AnswerParser, AnswerReader
from tests.fuzzing import examples, fuzz

texts = st.text(st.characters(codec="utf-8", exclude_categories=["Cc", "Cs"]), max_size=20)
scalars = texts | st.integers(-(2**31), 2**31 - 1) | st.booleans() | st.none()
values = st.recursive(
    scalars | st.floats(allow_nan=False, allow_infinity=False),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(texts, inner, max_size=3),
    max_leaves=12,
)


def read(data: bytes, pieces: int = 1) -> Any:
    parser = AnswerParser()
    step = len(data) // pieces + 1
    for at in range(0, len(data), step):
        parser.feed(data[at : at + step])
    parser.close()
    return AnswerReader(parser).close()


@given(values, st.integers(1, 5))
def test_values_are_read_as_the_standard_library_does(value: Any, pieces: int) -> None:
    text = xmlrpc.client.dumps((value,), methodresponse=True, allow_none=True)
    expected = xmlrpc.client.loads(text)[0]
    assert read(text.encode(), pieces) == expected


@pytest.mark.parametrize("piece", [b"<i4>1</i4>", b"<array>" * 5000])
def test_an_answer_without_end_is_refused(piece: bytes) -> None:
    parser = AnswerParser()
    parser.feed(b"<methodResponse>")
    with pytest.raises(ValueError, match="more than"):
        for _ in range(MOST_BYTES // len(piece) + 1):
            parser.feed(piece)


def test_values_nested_too_deep_are_refused() -> None:
    value: Any = 1
    for _ in range(DEEPEST + 2):
        value = [value]
    with pytest.raises(ValueError, match="nested deeper"):
        read(xmlrpc.client.dumps((value,), methodresponse=True).encode())


@fuzz
@settings(max_examples=examples(50))
@given(st.data())
def test_damaged_answers_are_values_or_errors_that_a_call_expects(data: st.DataObject) -> None:
    whole = xmlrpc.client.dumps((data.draw(values),), methodresponse=True, allow_none=True)
    damaged = bytearray(whole.encode())
    for at in data.draw(st.lists(st.integers(0, len(damaged) - 1), min_size=1, max_size=4)):
        damaged[at] = data.draw(st.integers(0, 255))
    with suppress(ParseError, LookupError, TypeError, ValueError, xmlrpc.client.Error):
        read(bytes(damaged))


def test_untyped_and_empty_values_are_text() -> None:
    text = b"<methodResponse><params><param><value>odom</value></param></params></methodResponse>"
    assert read(text) == ("odom",)
    assert read(text.replace(b"odom", b"<string/>")) == ("",)


def test_a_fault_is_raised() -> None:
    text = xmlrpc.client.dumps(xmlrpc.client.Fault(1, "no such method"))
    with pytest.raises(xmlrpc.client.Fault, match="no such method"):
        read(text.encode())


@pytest.mark.parametrize(
    "text",
    [
        b"<html/>",
        b"<methodResponse/>",
        b"<methodResponse><params><param/></params></methodResponse>",
        b"<methodResponse><params><param><value><date/></value></param></params></methodResponse>",
    ],
)
def test_what_is_no_answer_is_refused(text: bytes) -> None:
    with pytest.raises(ValueError, match=r"."):
        read(text)


def test_what_is_no_xml_is_refused() -> None:
    with pytest.raises(ParseError):
        read(b"220 ftp ready")
