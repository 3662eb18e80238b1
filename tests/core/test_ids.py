"""Ids match their pattern, and every name has one."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from amberbox.core.names import derive_id, is_id


@pytest.mark.parametrize("text", ["a", "ropod_001", "a.b-c", "x" * 64, "7"])
def test_ids(text: str) -> None:
    assert is_id(text)
    assert derive_id(text) == text


@pytest.mark.parametrize("text", ["", "A", "a b", "x" * 65, "ä", "..", ".", "a/b", "a\n"])
def test_no_ids(text: str) -> None:
    assert not is_id(text)


def test_derived_ids_stay_readable() -> None:
    assert derive_id("Ropod #1 (Köln)") == "ropod_1_koln"
    assert derive_id("../etc") == "etc"
    assert derive_id("x" * 70) != derive_id("x" * 71)


@given(st.text())
def test_every_name_has_an_id(text: str) -> None:
    assert is_id(derive_id(text))
    assert derive_id(derive_id(text)) == derive_id(text)
