"""Digests of stretches find exactly the journals that a server lacks, whatever both ends hold."""

from __future__ import annotations

import msgspec
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from amberbox.link import holdings
from amberbox.link.holdings import STRETCH, STRETCHES, Answer, Copy, Question
from tests.fuzzing import examples, fuzz

COPIES = st.lists(
    st.builds(
        lambda folder, run, number, size, holds: Copy(
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


def lacking(counted_on: list[Copy], held: list[Copy]) -> tuple[list[str], list[Answer]]:
    """Ask as a robot does, through the bytes that go over the network."""
    found, answers = [], []
    for asked in holdings.questions(holdings.stretches_of(counted_on)):
        question = msgspec.msgpack.encode(Question([stretch for stretch, _ in asked]))
        assert len(question) <= holdings.QUESTION_BYTES
        answer = holdings.compared(msgspec.msgpack.decode(question, type=Question), held)
        answer = msgspec.msgpack.decode(msgspec.msgpack.encode(answer), type=Answer)
        found += holdings.lacking(asked, answer)
        answers.append(answer)
    return found, answers


@fuzz
@given(COPIES, COPIES, st.data())
@settings(max_examples=examples(60), deadline=None)
def test_exactly_what_is_not_held_is_found(
    counted_on: list[Copy], others: list[Copy], data: st.DataObject
) -> None:
    kept = data.draw(st.lists(st.sampled_from(counted_on), unique=True)) if counted_on else []
    held = [*kept, *others]  # of one name there may be several: what is aside
    found, _ = lacking(counted_on, held)
    assert sorted(found) == sorted(copy.name for copy in counted_on if copy not in held)


def test_what_agrees_is_not_listed_and_a_missing_one_lists_its_stretch_alone() -> None:
    held = [Copy(f"journal/000001-ab-{number:04}.mcap", 7) for number in range(10_000)]
    later = held[5000:]  # the robot has deleted the others
    assert lacking(later, held) == ([], [Answer({})])
    gone = held[7001]
    found, [answer] = lacking(later, [copy for copy in held if copy != gone])
    assert found == [gone.name]
    assert [len(listed) for listed in answer.differing.values()] == [STRETCH - 1]


def test_the_longest_question_and_answer_fit() -> None:
    stretch = [Copy(f"journal/{0:012}-{'f' * 16}-{n:012}.mcap", 1 << 40) for n in range(STRETCH)]
    runs = [f"journal/{run:012}-{'f' * 16}" for run in range(STRETCHES)]
    [(one, _)] = holdings.stretches_of(stretch)
    question = Question([msgspec.structs.replace(one, run=run) for run in runs])
    assert len(msgspec.msgpack.encode(question)) < holdings.QUESTION_BYTES
    held = (Copy(f"{run}-{n:012}.mcap", 1 << 40) for run in runs for n in range(1, STRETCH))
    answer = holdings.compared(question, held)
    assert len(answer.differing) == STRETCHES
    assert len(msgspec.msgpack.encode(answer)) < 2 << 20, "a robot reads 4 MB"


@pytest.mark.parametrize("name", ["", "journal/x.mcap", "../journal/1-a-1.mcap", "1-a-1.mcap"])
def test_what_is_no_journal_s_name_is_left_out(name: str) -> None:
    assert holdings.stretches_of([Copy(name, 1)]) == []
    assert holdings.compared(Question([]), [Copy(name, 1)]) == Answer({})
