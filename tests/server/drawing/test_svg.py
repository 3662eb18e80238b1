"""Elements: text stays text, numbers stay short, nothing dangerous gets in."""

from __future__ import annotations

import math

import jinja2
import pytest
from hypothesis import given
from hypothesis import strategies as some

from amberbox.core.svg import (
    ELLIPSIS,
    broken,
    element,
    fitted,
    fluid,
    lettering,
    linked,
    number,
    root,
    width,
)
from tests.server.drawing.parsed import HOSTILE, parsed, shown, titles


def test_template_inserts_it_as_it_is() -> None:
    """Insert an element where everything else is escaped."""
    environment = jinja2.Environment(autoescape=True)
    drawn = environment.from_string("{{ part }}{{ text }}").render(
        part=element("text", "a < b", class_="x"), text="<b>"
    )
    assert drawn == '<text class="x">a &lt; b</text>&lt;b&gt;'


@given(some.text(max_size=40), some.text(max_size=40))
def test_any_text_is_well_formed(text: str, value: str) -> None:
    """Any text is written so that a parser reads one element with one text."""
    tree = parsed(element("text", text, data_id=value))
    assert tree.tag == "text"
    assert not list(tree)


@pytest.mark.parametrize("hostile", HOSTILE)
def test_hostile_text_is_text(hostile: str) -> None:
    """Text that looks like markup is shown as text."""
    tree = parsed(root("x", (10, 10), hostile, (lettering(hostile, (0, 0), 900),)))
    kept = "".join(c for c in hostile if c.isprintable() and c.isascii()).strip()
    assert kept in shown(tree).replace("\ufffd", "").replace("\u202e", "").replace("\u200f", "")
    assert len(list(tree.iter())) == 2


@pytest.mark.parametrize(("value", "text"), [
    (1, "1"), (1.5, "1.5"), (1 / 3, "0.33"), (-0.001, "0"), (100.0, "100"),
])  # fmt: skip
def test_numbers_are_short(value: float, text: str) -> None:
    """Write at most two decimals."""
    assert number(value) == text


def test_nanoseconds_keep_every_digit() -> None:
    """Whole numbers are written unchanged: floats have too few digits for times."""
    assert element("g", data_from=1799998995000000001).get("data-from") == "1799998995000000001"


@pytest.mark.parametrize("value", [math.nan, math.inf])
def test_no_place_is_an_error(value: float) -> None:
    """Refuse numbers that are none."""
    with pytest.raises(ValueError, match="no place"):
        element("rect", x=value)


@pytest.mark.parametrize("name", ["style", "onclick", "onload"])
def test_no_style_and_no_handlers(name: str) -> None:
    """Refuse what the pages' policy forbids."""
    with pytest.raises(ValueError, match="no attribute"):
        element("rect", **{name: "x"})


@pytest.mark.parametrize(
    "href", ["javascript:alert(1)", "//elsewhere", "https://x", "data:,x", " /"]
)
def test_links_stay_on_the_site(href: str) -> None:
    """Refuse addresses elsewhere."""
    with pytest.raises(ValueError, match="does not link"):
        linked(href, element("g"))


def test_image_has_a_name() -> None:
    """Be an image with a name."""
    tree = parsed(root("graph", (10.2, 5), "What needs what", ()))
    assert (tree.get("role"), tree.get("aria-label")) == ("img", "What needs what")
    assert tree.get("viewBox") == "0 0 11 5"


def test_links_make_it_a_group() -> None:
    """An element with links inside is a group: the contents of an image cannot be reached."""
    part = linked("/robots/1", element("g"))
    assert root("graph", (1, 1), "x", (part,)).get("role") == "group"


def test_fluid_has_no_box_of_its_own() -> None:
    """Be as wide as there is room, without a scale."""
    drawing = fluid("x", 20, "x", ())
    assert (drawing.get("width"), drawing.get("height")) == ("100%", "20")
    assert drawing.get("viewBox") == ""


@given(some.text(max_size=60), some.floats(20, 300))
def test_shortened_text_fits(text: str, most: float) -> None:
    """Leave no more than there is room for."""
    assert width(fitted(text, most)) <= most


def test_shortened_text_is_whole_in_its_title() -> None:
    """The full text is in the tooltip, and only if it was shortened."""
    long = "a long name of a component that has no room"
    tree = parsed(lettering(long, (0, 0), 80))
    assert shown(tree).endswith(ELLIPSIS)
    assert titles(parsed(root("x", (1, 1), "x", (lettering(long, (0, 0), 80),)))) == [long]
    assert not parsed(lettering("short", (0, 0), 80)).findall("title")


def test_lines_end_in_an_ellipsis() -> None:
    """Break into as many lines as there may be."""
    lines = broken("one two three four five six seven eight nine ten", 90, 2)
    assert len(lines) == 2
    assert lines[1].endswith(ELLIPSIS)
    assert broken("one two", 300, 2) == ["one two"]
