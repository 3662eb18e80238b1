"""Active and cleared causes are distinguished, and symptoms are listed by importance."""

from __future__ import annotations

from dataclasses import replace

from amberbox.diagnosis.report.explain import explain
from amberbox.diagnosis.report.explanation import Explanation
from amberbox.diagnosis.report.text import as_text
from tests.diagnosis.report.robot import (
    ENCODER,
    START_NS,
    STOPPED,
    WINDOW,
    diagnosis,
    explained,
    knowledge,
    symptoms,
)

GONE_NS = START_NS + 30 * 10**9


def told(*present: str, gone: tuple[str, ...] = ()) -> Explanation:
    """Explain present symptoms; those in ``gone`` have disappeared and are remembered."""
    seen = symptoms(knowledge(), present)
    found = diagnosis(knowledge(), seen)
    marked = [replace(s, gone_ns=GONE_NS if s.id in gone else None) for s in seen]
    return explain(found, knowledge(), marked)


def test_the_worst_that_is_seen_stands_first_whenever_it_came() -> None:
    because = explained(*WINDOW, *STOPPED).because
    assert [seen.id for seen in because] == [*STOPPED, *WINDOW]
    assert because[0].weight > because[-1].weight > 0


def test_a_cause_of_which_nothing_shows_any_more_is_told_apart() -> None:
    before, after = told(*ENCODER, *WINDOW), told(*ENCODER, *WINDOW, gone=ENCODER)
    assert before.broken is not None and after.broken is not None
    assert "encoder" in before.headline and "encoder" not in after.headline
    assert "encoder" not in after.broken.text and "window" in after.broken.text
    (cleared,) = after.cleared
    assert (cleared.id, cleared.gone_ns) == ("wheel_left#encoder_stuck", GONE_NS)
    assert before.cleared == ()
    assert [seen.id for seen in after.because] == [*WINDOW, *ENCODER]
    assert [seen.gone_ns for seen in after.because] == [None, GONE_NS, GONE_NS]


def test_what_shows_no_more_does_not_say_whether_the_robot_can_be_used() -> None:
    assert told(*ENCODER, *WINDOW).use.severity == "critical"
    assert told(*ENCODER, *WINDOW, gone=ENCODER).use.severity in ("warning", "urgent")


def test_nothing_is_asked_of_a_cause_that_shows_no_more() -> None:
    step = told(*ENCODER, *WINDOW, gone=ENCODER).next
    assert step.test == "laser_front.window"
    assert all("encoder" not in action.text for action in step.order)


def test_half_of_it_still_seen_is_active() -> None:
    assert told(*ENCODER, *WINDOW, gone=ENCODER[:1]).cleared == ()


def test_the_text_says_since_when() -> None:
    text = as_text(told(*ENCODER, *WINDOW, gone=ENCODER))
    title = text.index("What was broken and shows no more")
    assert text.index("What is broken") < title < text.index("How sure")
    assert "since 00:00:30 UTC" in text[title:]
    assert "gone since 00:00:30 UTC" in " ".join(text.split())


def test_all_gone_is_told_as_it_was() -> None:
    gone = told(*ENCODER, gone=ENCODER)
    assert gone.cleared == () and "encoder" in gone.headline


def test_what_differs_by_a_cleared_cause_alone_is_one_possibility() -> None:
    after = told(*ENCODER, *WINDOW, gone=ENCODER)
    texts = [group.text for group in (after.broken, *after.others) if group]
    assert len(texts) == len(set(texts))
    assert sum(group.probability for group in (after.broken, *after.others) if group) < 1.01
