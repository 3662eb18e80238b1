"""Digests of ranges find exactly the journals that a server lacks, for any holdings of
both ends.
"""

from __future__ import annotations

import msgspec
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from amberbox.link import uploads
from amberbox.link.uploads import (
    MOST_RANGES,
    RANGE_FILES,
    HoldingsAnswer,
    HoldingsQuestion,
    JournalCopy,
)
from tests.fuzzing import examples, fuzz

COPIES = st.lists(
    st.builds(
        lambda folder, run, number, size, holds: JournalCopy(
            f"{folder}/{run:06}-ab{run}-{number:04}.mcap", size, holds
        ),
        st.sampled_from(["journal", "ring"]),
        st.integers(0, 2),
        st.integers(0, 300),
        st.integers(1, 3),
        st.booleans(),
    ),
    max_size=60,
    unique_by=lambda copy: copy.name,
)


def lacking(
    counted_on: list[JournalCopy], held: list[JournalCopy]
) -> tuple[list[str], list[HoldingsAnswer]]:
    """Ask as a robot does, through the bytes that go over the network."""
    found, answers = [], []
    for asked in uploads.questions(uploads.journal_ranges(counted_on)):
        question = msgspec.msgpack.encode(HoldingsQuestion([stretch for stretch, _ in asked]))
        assert len(question) <= uploads.QUESTION_BYTES
        answer = uploads.compare_holdings(
            msgspec.msgpack.decode(question, type=HoldingsQuestion), held
        )
        answer = msgspec.msgpack.decode(msgspec.msgpack.encode(answer), type=HoldingsAnswer)
        found += uploads.missing_copies(asked, answer)
        answers.append(answer)
    return found, answers


@fuzz
@given(COPIES, COPIES, st.data())
@settings(max_examples=examples(60))
def test_exactly_what_is_not_held_is_found(
    counted_on: list[JournalCopy], others: list[JournalCopy], data: st.DataObject
) -> None:
    kept = data.draw(st.lists(st.sampled_from(counted_on), unique=True)) if counted_on else []
    held = [*kept, *others]  # of one name there may be several: what is aside
    found, _ = lacking(counted_on, held)
    assert sorted(found) == sorted(copy.name for copy in counted_on if copy not in held)


def test_what_agrees_is_not_listed_and_a_missing_one_lists_its_stretch_alone() -> None:
    held = [JournalCopy(f"journal/000001-ab-{number:04}.mcap", 7) for number in range(10_000)]
    later = held[5000:]  # the robot has deleted the others
    assert lacking(later, held) == ([], [HoldingsAnswer({})])
    gone = held[7001]
    found, [answer] = lacking(later, [copy for copy in held if copy != gone])
    assert found == [gone.name]
    assert [len(listed) for listed in answer.differing.values()] == [RANGE_FILES - 1]


def test_the_longest_question_and_answer_fit() -> None:
    stretch = [
        JournalCopy(f"journal/{0:012}-{'f' * 16}-{n:012}.mcap", 1 << 40) for n in range(RANGE_FILES)
    ]
    runs = [f"journal/{run:012}-{'f' * 16}" for run in range(MOST_RANGES)]
    [(one, _)] = uploads.journal_ranges(stretch)
    question = HoldingsQuestion([msgspec.structs.replace(one, run=run) for run in runs])
    assert len(msgspec.msgpack.encode(question)) < uploads.QUESTION_BYTES
    held = (
        JournalCopy(f"{run}-{n:012}.mcap", 1 << 40) for run in runs for n in range(1, RANGE_FILES)
    )
    answer = uploads.compare_holdings(question, held)
    assert len(answer.differing) == MOST_RANGES
    assert len(msgspec.msgpack.encode(answer)) < 2 << 20, "a robot reads 4 MB"


@pytest.mark.parametrize("name", ["", "journal/x.mcap", "../journal/1-a-1.mcap", "1-a-1.mcap"])
def test_what_is_no_journal_s_name_is_left_out(name: str) -> None:
    assert uploads.journal_ranges([JournalCopy(name, 1)]) == []
    assert uploads.compare_holdings(HoldingsQuestion([]), [JournalCopy(name, 1)]) == HoldingsAnswer(
        {}
    )
