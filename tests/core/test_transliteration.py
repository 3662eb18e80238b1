"""Words of other scripts in Latin letters."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from amberbox.core.names import (
    LONGEST,
    extend_names,
    identifier,
    item_name,
    readable_identifier,
    to_latin,
    unique_names,
)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("plain_Text/9", "plain_Text/9"),
        ("скорость", "skorost"),
        ("Щука-ЖУК", "Shchuka-ZhUK"),
        ("Ελλάδα", "Ellada"),
        ("café naïve Straße Łódź", "cafe naive Strasse Lodz"),
        ("cafe\u0301", "cafe"),
        ("温度", "u6e29u5ea6"),
        ("속도", "sogdo"),
        ("かな", "kana"),
        ("٣", "3"),
        ("سر", "seen_reh_"),
        ("😀", "😀"),
    ],
)
def test_letters_of_many_scripts(text: str, expected: str) -> None:
    assert to_latin(text) == expected


@given(st.text(max_size=300))
def test_any_text_makes_a_bounded_identifier(text: str) -> None:
    name = readable_identifier(text)
    assert identifier(name) == name and len(name) <= LONGEST
    if text.isascii() and len(identifier(text)) <= LONGEST:
        assert name == identifier(text)


def test_names_of_long_and_of_similar_texts_differ() -> None:
    long = ["x" * 5000, "x" * 4999 + "y"]
    similar = ["скорость", "skorost", "Skorost"]
    for texts in (long, similar):
        names = unique_names(texts, plain=readable_identifier)
        assert len({name.casefold() for name in names.values()}) == len(texts)
        assert extend_names(names, ["more"], plain=readable_identifier) == {**names, "more": "more"}
    assert item_name("zmq", "/скорость/温") == "zmq_skorost_u6e29"
    assert item_name("zmq", "x" * 5000).startswith("zmq_xxx")
