"""Causes and tests that differ only in the instance of a type are combined."""

from __future__ import annotations

import pytest

from amberbox.diagnosis.report.wording import merge_texts
from tests.diagnosis.report.robot import explained
from tests.diagnosis.test_make_safe import told_of

BOTH = ("laser_front/window/clear", "laser_rear/window/clear")


@pytest.mark.parametrize(
    ("texts", "one"),
    [
        (
            ["the front left tyres are worn", "the rear left tyres are worn"],
            "the front or rear left tyres are worn",
        ),
        (["see the left one", "see the right one", "see the upper one"],
         "see the left, right or upper one"),
        (["look left", "go"], "look left; or go"),
        (["see it", "see it now"], "see it; or see it now"),
        (["same", "same"], "same"),
        (["a a b", "a b"], "a a b; or a b"),
    ],
)  # fmt: skip
def test_texts_that_differ_in_some_words_are_merged(texts: list[str], one: str) -> None:
    assert merge_texts(texts) == one


def test_which_laser_is_one_question() -> None:
    _, told = told_of("localisation#map_old", unseen=".covered")
    step = told.next
    front, rear = ("front", "laser_front.window"), ("rear", "laser_rear.window")
    assert sorted((one.where, one.test) for one in step.instances) == [front, rear]
    assert step.text.startswith("Which one is it? Look at the window of the ")
    assert step.text.endswith(("front or rear laser.", "rear or front laser."))
    assert step.test == step.instances[0].test, "its answers are those of the first"


def test_one_instance_alone_is_no_question_of_which() -> None:
    step = explained(BOTH[0]).next
    assert step.instances == () and "Which one" not in step.text
