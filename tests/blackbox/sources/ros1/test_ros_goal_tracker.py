"""The state of a goal, from what an action server publishes or does not."""

from __future__ import annotations

from typing import Any

import pytest

from amberbox.blackbox.sources.ros1.action_client import STATES, GoalTracker


def status(state: str, goal: str = "/a-1", text: str = "") -> dict[str, Any]:
    number = STATES.index(state) if state in STATES else 77
    return {"goal_id": {"id": goal}, "status": number, "text": text}


def result(state: str, goal: str = "/a-1", value: int = 42) -> dict[str, Any]:
    return {"status": status(state, goal, "it\nsays"), "result": {"result": value}}


@pytest.fixture
def goal() -> GoalTracker:
    return GoalTracker("/a-1", sent_s=100.0)


def test_a_goal_goes_its_way(goal: GoalTracker) -> None:
    goal.status_received([status("active", "/b-1")], 100.5)
    seen: list[str] = [goal.state]
    for state in ("pending", "active", "preempting"):
        goal.status_received([status("active", "/b-1"), status(state)], 101.0)
        seen.append(goal.state)
    assert seen == ["", "pending", "active", "preempting"]
    goal.result_received(result("preempted"))
    assert (goal.state, goal.text, goal.result) == ("preempted", "it says", {"result": 42})
    goal.result_received(result("succeeded", value=1))
    goal.status_received([], 102.0)
    goal.advance(1000.0)
    assert goal.state == "preempted"


@pytest.mark.parametrize("state", ["preempted", "succeeded", "aborted", "rejected", "recalled"])
def test_a_result_ends_the_goal_before_any_status(goal: GoalTracker, state: str) -> None:
    goal.result_received(result(state))
    assert goal.is_over and goal.state == state


def test_results_and_feedback_of_other_goals_are_ignored(goal: GoalTracker) -> None:
    goal.status_received([status("active")], 101.0)
    goal.result_received(result("succeeded", "/a-2"))
    assert not goal.feedback_received({"status": status("active", "/a-2"), "feedback": {"f": 1}})
    assert (goal.state, goal.result, goal.feedback) == ("active", None, None)
    assert goal.feedback_received({"status": status("active"), "feedback": {"f": 2}})
    assert goal.feedback == {"f": 2}


def test_a_late_status_does_not_turn_back_time(goal: GoalTracker) -> None:
    goal.status_received([status("preempting")], 101.0)
    for state in ("active", "pending", "recalling", "unknown"):
        goal.status_received([status(state)], 101.0)
        assert goal.state == "preempting"


def test_a_status_that_ends_the_goal_waits_for_the_result(goal: GoalTracker) -> None:
    goal.status_received([status("succeeded", text="fine")], 101.0)
    goal.advance(102.9)
    assert not goal.is_over
    goal.result_received(result("succeeded"))
    assert goal.result == {"result": 42}


def test_a_result_that_does_not_come(goal: GoalTracker) -> None:
    goal.status_received([status("aborted", text="broken")], 101.0)
    goal.status_received([], 102.0)
    goal.advance(103.1)
    assert (goal.state, goal.text, goal.result) == ("aborted", "broken", None)


def test_a_result_without_an_end(goal: GoalTracker) -> None:
    goal.result_received(result("active"))
    assert goal.state == "lost" and "in the state active" in goal.text


def test_a_goal_that_nobody_takes(goal: GoalTracker) -> None:
    goal.status_received([], 104.0)
    goal.advance(105.0)
    assert not goal.is_over
    goal.advance(105.1)
    assert goal.state == "lost" and "did not take the goal within 5 s" in goal.text


def test_a_server_that_forgets(goal: GoalTracker) -> None:
    goal.status_received([status("active")], 101.0)
    goal.status_received([status("active", "/b-1")], 101.2)
    assert goal.state == "lost" and "restarted" in goal.text


def test_a_server_that_is_silent(goal: GoalTracker) -> None:
    goal.status_received([status("active")], 101.0)
    goal.advance(106.0)
    assert not goal.is_over
    goal.advance(106.1)
    assert goal.state == "lost" and "silent for 5 s" in goal.text


def test_a_server_that_goes_away(goal: GoalTracker) -> None:
    goal.status_received([status("active")], 101.0)
    goal.server_left(101.0)
    goal.server_left(109.0)
    goal.advance(101.2)
    assert not goal.is_over  # its result may be on the way
    goal.advance(101.4)
    assert goal.state == "lost" and "gone" in goal.text


def test_a_server_that_goes_away_after_it_said_how_the_goal_ended(goal: GoalTracker) -> None:
    goal.status_received([status("succeeded")], 101.0)
    goal.server_left(101.0)
    goal.advance(101.0)
    assert goal.state == "succeeded"
