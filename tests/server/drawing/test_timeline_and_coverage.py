"""Lanes of states and coverage: places in percent, patterns and words, times in attributes."""

from __future__ import annotations

from xml.etree import ElementTree

import pytest

from amberbox.server.drawing import charts as covering
from amberbox.server.drawing.charts import (
    AxisTick,
    StateInterval,
    TimeAxis,
    TimelineLane,
    TimelineMarker,
    timeline,
)
from tests.server.drawing.parsed import HOSTILE, WORDS, of_class, parsed, shown, texts, titles

START = 1799998995000000000
SECOND = 1_000_000_000
AXIS = TimeAxis(START, START + 100 * SECOND)
LASER = TimelineLane(
    "laser", "front laser",
    (
        StateInterval(START - 50 * SECOND, START + 40 * SECOND, "ok"),
        StateInterval(START + 40 * SECOND, START + 70 * SECOND, "error", "no scans", "/at"),
        StateInterval(START + 70 * SECOND, START + 90 * SECOND, "gap"),
        StateInterval(START + 90 * SECOND, START + 90 * SECOND + 1, "warn", "slow"),
    ),
    "/laser",
)  # fmt: skip


def _drawn(*lanes: TimelineLane, **more: object) -> ElementTree.Element:
    return parsed(timeline(lanes or (LASER,), AXIS, label="States", words=WORDS, **more))  # type: ignore[arg-type]  # forwarded as they are


def _bar(tree: ElementTree.Element, level: str) -> ElementTree.Element:
    return of_class(tree, f"bar-{level}")[0]


def test_stretches_stand_where_they_belong() -> None:
    """Place by time; cut at the edges; keep the shortest visible."""
    tree = _drawn()
    assert (_bar(tree, "ok").get("x"), _bar(tree, "ok").get("width")) == ("0.000%", "40.000%")
    assert (_bar(tree, "error").get("x"), _bar(tree, "error").get("width")) == (
        "40.000%", "30.000%",
    )  # fmt: skip
    assert _bar(tree, "warn").get("width") == "0.200%"


def test_stretches_say_from_when_to_when() -> None:
    """Carry the times as they were given, to the nanosecond."""
    ranges = [(s.get("data-from"), s.get("data-to")) for s in of_class(_drawn(), "stretch")]
    assert sorted(map(str, ranges)) == sorted(
        str((str(s.start), str(s.to))) for s in LASER.stretches
    )


def test_levels_differ_by_pattern_or_height() -> None:
    """Levels can be distinguished without colours."""
    levels = ("ok", "warn", "error", "stale", "unknown", "gap")
    spans = tuple(StateInterval(START + n, START + n + SECOND, x) for n, x in enumerate(levels))
    tree = _drawn(TimelineLane("x", "x", spans))
    looks = {(_bar(tree, x).get("fill"), _bar(tree, x).get("height")) for x in levels}
    assert len(looks) == len(levels)
    ids = [part.get("id") for part in tree.iter() if part.get("id")]
    fills = {fill for fill, _ in looks if fill}
    assert fills == {f"url(#{name})" for name in ids}


def test_words_stand_where_there_is_room() -> None:
    """Write the level into its stretch; in its title in any case."""
    tree = _drawn()
    assert "error" in texts(tree)
    assert "warning" not in texts(tree)
    assert "warning: slow" in titles(tree)
    assert "nothing known" in titles(tree)


def test_worst_is_drawn_over_the_rest() -> None:
    """Draw errors last."""
    kinds = [part.get("class", "").split()[-1] for part in of_class(_drawn(), "stretch")]
    assert kinds == ["state-gap", "state-ok", "state-warn", "state-error"]


def test_ticks_and_markers_stand_at_their_times() -> None:
    """Show the caller's labels, and markers that lie on the axis."""
    markers = [
        TimelineMarker(START + 50 * SECOND, "alarm", "no scans", "/alarms/1"),
        TimelineMarker(START - 1, "incident", "before"),
        TimelineMarker(START + SECOND, "sunrise", "light"),
    ]
    tree = _drawn(ticks=[AxisTick(START + 25 * SECOND, "14:03")], markers=markers)
    label = next(part for part in tree.iter() if part.text == "14:03")
    assert label.get("x") == "25.000%"
    signs = [(m.get("class"), m.get("x"), m.get("data-at")) for m in of_class(tree, "marker")]
    assert signs == [
        ("marker marker-alarm", "50.000%", str(START + 50 * SECOND)),
        ("marker marker-note", "1.000%", str(START + SECOND)),
    ]
    links = [part.get("href") for part in tree.iter() if part.get("href")]
    assert links == ["/laser", "/at", "/alarms/1"]


def test_ids_begin_with_the_name() -> None:
    """Two drawings can be on one page."""
    one, two = (_drawn(name=name) for name in ("a", "b"))
    ids = [{part.get("id") for part in tree.iter()} - {None} for tree in (one, two)]
    assert not ids[0] & ids[1]


def test_swatches_show_every_look() -> None:
    """Give legends a sample with its word."""
    kinds = [
        parsed(covering.coverage_swatch(kind, name="s", words=WORDS)) for kind in covering.KINDS
    ]
    assert len({tree.get("aria-label") for tree in kinds}) == len(covering.KINDS)


def test_axis_has_a_length() -> None:
    """Refuse to show no time at all."""
    with pytest.raises(ValueError, match="ends after"):
        TimeAxis(5, 5)


@pytest.mark.parametrize("hostile", HOSTILE)
def test_hostile_names_are_text(hostile: str) -> None:
    """Draw any name as text."""
    lane = TimelineLane(hostile, hostile, (StateInterval(START, START + SECOND, hostile, hostile),))
    tree = _drawn(lane, markers=[TimelineMarker(START, hostile, hostile)])
    assert not {"script", "img"} & {part.tag.rpartition("}")[2] for part in tree.iter()}
    assert "unknown" in shown(tree)


def test_coverage_is_told_apart_without_colours() -> None:
    """Each kind has a pattern of its own, incidents are below the bar."""
    spans = [
        covering.CoverageInterval(START + n * 9 * SECOND, START + (n + 1) * 9 * SECOND, kind, "why")
        for n, kind in enumerate(covering.KINDS)
    ]
    drawing = covering.coverage(spans, AXIS, label="What is there", name="c", words=WORDS)
    tree = parsed(drawing)
    looks = {(bar.get("fill"), bar.get("y")) for bar in of_class(tree, "bar")}
    assert len(looks) == len(covering.KINDS)
    assert "lost: why" in titles(tree)
    assert [s.get("data-from") for s in of_class(tree, "stretch")] == [str(s.start) for s in spans]
    assert drawing.get("aria-label") == "What is there"


def test_coverage_outside_is_left_out() -> None:
    """Only intervals on the axis are drawn."""
    spans = [covering.CoverageInterval(START - 9, START - 5, "recorded")]
    assert not of_class(parsed(covering.coverage(spans, AXIS, label="x", words=WORDS)), "stretch")
