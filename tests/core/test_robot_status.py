"""The one status of a robot: its inputs, its order, its sentence."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from amberbox.core.robot_status import (
    NOTHING_KNOWN,
    NOTHING_WRONG,
    RANK,
    SEVERITIES,
    Observed,
    components_level,
    judge,
    severity_rank,
    use_text,
)
from tests.fuzzing import examples, fuzz

FINE = Observed(level="ok", as_of="2027-01-15T08:00:00Z")
SEEN = st.builds(
    Observed,
    st.sampled_from(["online", "silent", "offline", "never"]),
    st.sampled_from(["running", "overloaded", "silent", "absent"]),
    st.sampled_from(sorted(RANK)), st.text(max_size=5),
    st.sampled_from(["", *SEVERITIES]), st.text(max_size=5), st.booleans(),
    st.sampled_from(["", *SEVERITIES]),
)  # fmt: skip


@pytest.mark.parametrize(
    ("seen", "level", "text"),
    [
        (FINE, "ok", NOTHING_WRONG),
        (replace(FINE, level="error", reason="laser: dead"), "error",
         "Something of it does not do its work."),
        (replace(FINE, alarm="critical"), "error",
         "Critical: it cannot go on with what it does."),
        (replace(FINE, alarm="warning"), "warn", "Warning: it works."),
        (replace(FINE, diagnosed=True), "warn", "Something is not as expected."),
        (replace(FINE, diagnosed=True, effect="fatal"), "error",
         "Fatal: it must stop and stay stopped."),
        (replace(FINE, monitoring="overloaded", delay_s=25.3), "unknown",
         "Its monitoring is overloaded: what it says comes 25 s late. "
         "When it was last heard of: fine."),
        (replace(FINE, contact="offline"), "unknown", "When it was last heard of: fine."),
        (replace(FINE, contact="offline", level="error", alarm="urgent"), "unknown",
         "When it was last heard of: error; urgent: it works, see to it soon."),
        (replace(FINE, monitoring="silent"), "unknown",
         "Its watcher is silent. When it was last heard of: fine."),
        (Observed("never", "absent"), "unknown", NOTHING_KNOWN),
    ],
)  # fmt: skip
def test_level_and_sentence(seen: Observed, level: str, text: str) -> None:
    assert (judge(seen).level, judge(seen).text) == (level, text)


def test_the_order_is_one_from_fine_to_fatal() -> None:
    seen = [
        FINE, replace(FINE, level="warn"), replace(FINE, alarm="warning"),
        replace(FINE, contact="offline"), replace(FINE, contact="offline", level="error"),
        replace(FINE, level="stale"), replace(FINE, level="error"), replace(FINE, alarm="urgent"),
        replace(FINE, alarm="critical"), replace(FINE, level="stale", alarm="fatal"),
    ]  # fmt: skip
    assert all(low.rank < high.rank for low, high in pairwise(map(judge, seen)))


def test_what_has_no_monitor_does_not_count() -> None:
    assert components_level([("ok", "nominal"), ("unknown", "not_monitored")]) == "ok"
    assert components_level([("unknown", "not_monitored")]) == components_level([]) == "unknown"


def test_the_reason_is_of_what_makes_it_as_it_is() -> None:
    busy = replace(FINE, level="warn", reason="host: busy", alarm_reason="laser: dead")
    assert judge(busy).reason == "host: busy"
    assert judge(replace(busy, alarm="critical")).reason == "laser: dead"


@fuzz
@given(SEEN, SEEN)
@settings(max_examples=examples(200))
def test_level_severity_order_and_sentence_agree(one: Observed, other: Observed) -> None:
    said, also = judge(one), judge(other)
    assert (said.level == "ok") == (said.text == NOTHING_WRONG) == (said.rank == 0)
    assert said.is_current or said.level == "unknown"
    if said.is_current:
        assert said.level == said.last_level and RANK[said.level] >= RANK[one.level]
        assert use_text(said.severity).lower() in said.text.lower()
    if RANK[said.level] > RANK[also.level]:
        assert said.rank > also.rank
    if said.level == also.level and severity_rank(said.severity) > severity_rank(also.severity):
        assert said.rank > also.rank
