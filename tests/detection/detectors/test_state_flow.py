"""State flow: robots whose states, transitions and stays are known."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache

import numpy as np
import pytest

from amberbox.core.contracts import LearntState, Row
from amberbox.core.errors import AmberboxError
from amberbox.detection.detectors.state_flow import Config, Detector
from amberbox.testing.detectors import GivenMission, copied, mission, rows_of, run_detector

LEVELS = {"rest": (0.0, 0.0), "drive": (10.0, 0.0), "grasp": (0.0, 10.0), "fall": (-10.0, 20.0)}
ROUTE = ("rest", "drive", "grasp", "drive")


def robot(
    route: Sequence[tuple[str, float]], seed: int = 0, item: str = "robot", start_s: float = 0.0
) -> list[Row]:
    """Return the rows of a robot at 10 Hz that goes through states, staying in each for a while."""
    random = np.random.default_rng(seed)
    levels = np.concatenate([np.tile(LEVELS[name], (round(stay * 10), 1)) for name, stay in route])
    noisy = levels + random.normal(0, 0.5, levels.shape)
    times = start_s + np.arange(len(levels)) * 0.1
    return rows_of(item, times, {"speed": noisy[:, 0], "force": noisy[:, 1]})


def nominal(seed: int, rounds: int = 8) -> list[tuple[str, float]]:
    """Return a route through rest, drive, grasp, drive; stays of 6 to 10 s."""
    random = np.random.default_rng(seed)
    return [(name, float(random.uniform(6, 10))) for name in ROUTE * rounds]


@cache
def what_is_learnt() -> LearntState:
    detector = Detector(Config())
    detector.fit([mission(robot(nominal(seed), seed)) for seed in (1, 2, 3)])
    return detector.learnt()


def learnt() -> Detector:
    detector = Detector(Config())
    detector.restore(copied(what_is_learnt()))
    return detector


def worst(detector: Detector, rows: Sequence[Row], series: str, after_s: float = 0.0) -> float:
    """Return the greatest score of a series some seconds after the first row."""
    found = run_detector(detector, rows)
    since_ns = rows[0].at_ns + round(after_s * 1e9)
    return max(
        s.value for some in found for s in some if s.series == series and s.at_ns >= since_ns
    )


def test_the_states_of_the_robot_are_found() -> None:
    detector = learnt()
    names = {
        detector._members["robot"].label(k) for k in range(detector._members["robot"].flow.size)
    }
    assert any("robot.speed high" in name for name in names)
    assert any("robot.force high" in name for name in names)


@pytest.mark.parametrize(
    ("series", "strange"),
    [
        ("robot unknown_state", [*nominal(9, 2), ("fall", 3.0)]),
        ("robot transition", [*nominal(9, 2), ("rest", 8.0), ("grasp", 8.0), ("rest", 8.0)]),
        ("robot stay", [*nominal(9, 2), ("rest", 8.0), ("drive", 90.0)]),
    ],
)
def test_hard_and_logic_faults_have_scores_of_their_own(
    series: str, strange: list[tuple[str, float]]
) -> None:
    detector = learnt()
    usual = max(worst(detector, robot(nominal(seed), seed), series) for seed in (4, 5))
    assert worst(detector, robot(strange, 6), series) > 1.3 * usual
    reason = detector.explain(series)
    assert reason.finding == series.partition(" ")[2]


def test_the_variable_that_leaves_all_states_is_named() -> None:
    detector = learnt()
    rows = robot([*nominal(9, 2), ("rest", 3.0)], 6)
    strange = [
        row._replace(values={**row.values, "force": -30.0}) if i > len(rows) - 20 else row
        for i, row in enumerate(rows)
    ]
    run_detector(detector, strange)
    reason = detector.explain("robot unknown_state")
    assert (reason.item, reason.variable) == ("robot", "force")
    assert reason.contributions[0][0] == "robot.force"


def test_the_decoder_prints_the_last_transitions_with_probabilities() -> None:
    detector = learnt()
    run_detector(detector, robot([("rest", 8.0), ("drive", 8.0), ("fall", 5.0)], 6))
    lines = detector.explain("robot transition").transitions
    (fall,) = (n for n, line in enumerate(lines) if "-> unknown state" in line)
    shares = [float(line.partition("probability ")[2].partition(",")[0]) for line in lines]
    assert shares[fall] < 0.05 < max(shares[:fall])
    assert float(lines[fall].partition(" s:")[0]) == pytest.approx(-3.5, abs=1.1)
    assert float(lines[fall].rpartition("after ")[2].removesuffix(" s")) > 5


def events(names: Sequence[str], every_s: float = 0.2) -> list[Row]:
    rows = rows_of("log", np.arange(len(names)) * every_s)
    return [row._replace(texts={"call": name}) for row, name in zip(rows, names, strict=True)]


def calls(seed: int, count: int = 400) -> list[str]:
    """Return open, one to three reads, close, again and again."""
    random = np.random.default_rng(seed)
    found: list[str] = []
    while len(found) < count:
        found += ["open", *["read"] * int(random.integers(1, 4)), "close"]
    return found


def test_the_probabilities_of_events_are_those_of_the_nominal_missions() -> None:
    detector = Detector(Config(events=("log.call",), clusters=False))
    detector.fit([mission(events(calls(1, 3000)))])
    member = detector._members["log.call"]
    soft = np.eye(member.flow.size + 1)
    places = {member.label(k): k for k in range(member.flow.size)}
    assert set(places) == {"open", "read", "close"}
    before, after = soft[places["read"]], soft[places["close"]]
    assert member.flow.transitions.probability(soft[places["open"]], before, 0.2) > 0.99
    assert member.flow.transitions.probability(before, soft[places["open"]], 0.2) < 0.01
    # after one read as likely as not to be the last: 1 of 3; after two 1 of 2, after three for sure
    found = [member.flow.transitions.probability(before, after, s) for s in (0.2, 0.4, 0.6)]
    assert found[0] < found[-1]


@pytest.mark.parametrize("strange", [["open", "close"] * 10, ["read"] * 20, ["crash", "open"] * 10])
def test_events_in_another_order_or_new_ones_are_seen(strange: list[str]) -> None:
    detector = Detector(Config(events=("log.call",), clusters=False))
    detector.fit([mission(events(calls(seed, 2000))) for seed in (1, 2)])
    usual = worst(detector, events(calls(3)), "log.call transition", 10.0)
    assert worst(detector, events([*calls(4), *strange]), "log.call transition") > 1.5 * usual
    reason = detector.explain("log.call transition")
    assert (reason.finding, reason.item, reason.variable) == ("transition", "log", "call")
    assert len(reason.transitions) > 0


def test_silence_after_an_event_is_a_stay_that_is_too_long() -> None:
    detector = Detector(Config(events=("log.call",), clusters=False))
    detector.fit([mission(events(calls(1, 2000)))])
    rows = events(calls(3))
    usual = worst(detector, rows, "log.call stay")
    silent = run_detector(detector, rows, rows[-1].at_ns + 60 * 10**9)
    last = [s.value for some in silent for s in some if s.series == "log.call stay"][-1]
    assert last > 2 * usual


def test_a_team_whose_members_do_not_fit_together_is_seen() -> None:
    """Each robot does what it always does, but one grasps while the other drives."""
    config = Config(members={"left": ("left.*",), "right": ("right.*",)})

    def team(seed: int, lag: int) -> GivenMission:
        route = nominal(seed, 6)
        other = route[lag:] + route[:lag]
        return mission([*robot(route, seed, "left"), *robot(other, seed + 50, "right")])

    detector = Detector(config)
    detector.fit([team(seed, 0) for seed in (1, 2, 3)])
    usual = worst(detector, team(4, 0).rows, "team", 5.0)
    assert worst(detector, team(4, 1).rows, "team", 5.0) > 2 * usual
    reason = detector.explain("team")
    assert reason.finding == "team"
    assert "left: state" in reason.text and "right: state" in reason.text


def test_a_robot_that_never_left_a_state_cannot_stay_too_long() -> None:
    detector = Detector(Config())
    detector.fit([mission(robot([("rest", 20.0)], seed)) for seed in (1, 2)])
    assert worst(detector, robot([("rest", 100.0)], 3), "robot stay") == 0


def test_the_window_holds_20_messages_but_no_third_of_a_mission() -> None:
    slow = mission(rows_of("slow", np.arange(0, 400, 2.0), {"x": np.sin(np.arange(200))}))
    fast = mission(rows_of("fast", np.arange(0, 60, 0.01), {"x": np.sin(np.arange(6000))}))
    short = mission(rows_of("short", np.arange(0, 0.3, 0.02), {"x": np.sin(np.arange(15))}))
    lengths = []
    for given in (slow, fast, short):
        detector = Detector(Config())
        detector.fit([given, given])
        lengths.append(detector.learnt().values["options"]["window"])
    assert lengths == pytest.approx([30.0, 1.0, 0.28 / 3], rel=0.02)


def test_missions_that_are_too_short_are_told() -> None:
    detector = Detector(Config(window=60.0, step=30.0))
    with pytest.raises(AmberboxError, match="too short for windows of 60 s"):
        detector.fit([mission(robot([("rest", 20.0)]))])
    with pytest.raises(AmberboxError, match=r"no values of 'log.cal'"):
        Detector(Config(events=("log.cal",))).fit([mission(events(calls(1)))])


def test_options_that_do_not_fit_are_told() -> None:
    config = Config(
        variables=("a.b",), members={"team": ("c.d",)}, window=0.0, step=1e9, states=0,
        explained=0, smoothing=0, event_smoothing=2, clusters=False,
    )  # fmt: skip
    keys = [finding[0] for finding in config.check()]
    assert keys == ["window", "step", "states", "explained", "smoothing", "event_smoothing",
                    "variables", "events", "members"]  # fmt: skip
