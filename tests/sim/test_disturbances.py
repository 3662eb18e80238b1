"""Disturbances: each kind does what it says, and leaves everything else alone."""

from __future__ import annotations

import copy
import io
import json
import math
import queue
import threading
from collections import Counter
from collections.abc import Sequence
from itertools import cycle
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from amberbox.core.clock import NS
from amberbox.core.errors import ConfigurationError, UsageError
from amberbox.sim.__main__ import main
from amberbox.sim.disturbances import (
    CONVERSIONS,
    KINDS,
    Disturbance,
    Disturber,
    Message,
    address_problems,
    disturb,
    load_disturbances,
    parse_disturbance,
)
from amberbox.sim.live import LiveRun, publish
from amberbox.sim.random_disturbances import (
    Variable,
    draw,
    simulated_variables,
    survey,
)
from amberbox.sim.robot import Robot
from tests.fuzzing import examples, fuzz

START_NS = 1_700_000_000 * NS
AT_S, UNTIL_S = 2.0, 4.0
STEP_NS = NS // 10
VALUES = st.one_of(
    st.floats(allow_nan=False, width=32),
    st.sampled_from([0.0, -0.0, math.nan, math.inf, -math.inf, 1.7e308]),
)


@st.composite
def streams(draws: st.DrawFn) -> list[Message]:
    """Two items of 6 s, nested and flat, with all types of values, as a bus gives them."""
    made: list[Message] = []
    values = cycle(draws(st.lists(VALUES, min_size=7, max_size=7)))
    whole = cycle(draws(st.lists(st.integers(), min_size=3, max_size=3)))
    for step in range(60):
        nested = {
            "header": {"seq": step, "stamp": {"sec": step // 10, "nanosec": 0}},
            "state": {"a": next(values), "b": next(values), "count": next(whole)},
            "cells": [next(values) for _ in range(3)],
            "on": step % 3 == 0,
            "name": str(step),
            "none": None,
        }
        flat = {"header_seq": step, "state_a": next(values), "whole": step, "off": step % 2 == 0}
        made.append(("nested", START_NS + STEP_NS * step, nested))
        made.append(("flat", START_NS + STEP_NS * step + 1, flat))
    return made


@st.composite
def disturbances(draws: st.DrawFn) -> Disturbance:
    """Any kind, on any variable or item, with any amount."""
    kind = draws(st.sampled_from(list(KINDS)))
    facts = KINDS[kind]
    item = draws(st.sampled_from(["nested", "flat"]))
    names = ["state.a", "state.count", "cells", "cells[1]", "state", "on", "name", "none", "absent"]
    paths = names if item == "nested" else ["state_a", "whole", "off", "absent"]
    has_variable = facts.reach == "variable" or (facts.reach == "both" and draws(st.booleans()))
    variable, *others = draws(st.permutations(paths)) if has_variable else ("", "")
    low, high = max(facts.low, -1e9), min(facts.high, 1e9)
    amount = draws(st.none() | st.floats(low, high)) if facts.unit else None
    made = Disturbance(
        kind,
        item,
        variable,
        amount=amount,
        other=others[0] if kind == "swap" else "",
        conversion=draws(st.sampled_from(list(CONVERSIONS))) if kind == "unit" else "",
        at_s=AT_S,
        until_s=UNTIL_S,
    )
    assert list(made.check()) == []
    return made


def same(one: Any, other: Any) -> bool:
    """Tell whether two values are the same bit for bit."""
    return repr(one) == repr(other)


def is_inside(time_ns: int) -> bool:
    return AT_S * NS <= time_ns - START_NS < UNTIL_S * NS


def sent_with(stream: Sequence[Message], text: str, seed: int = 1) -> list[Message]:
    """Return a stream with one disturbance from AT_S until UNTIL_S."""
    made = parse_disturbance(f"{text}@{AT_S}s..{UNTIL_S}s")
    return list(disturb(stream, [made], START_NS, seed))


# -- what holds for every kind


@fuzz
@given(streams(), disturbances(), st.integers(0, 5))
@settings(max_examples=examples(60))
def test_the_rest_of_the_stream_is_untouched(
    stream: list[Message], made: Disturbance, seed: int
) -> None:
    before = copy.deepcopy(stream)
    received = list(disturb(stream, [made], START_NS, seed))
    assert same(stream, before), "the input is never changed"
    kept = [m for m in stream if m[0] != made.item or not is_inside(m[1])]
    passed = [m for m in received if any(m is k for k in kept)]
    assert [id(m) for m in passed] == [id(m) for m in kept]
    for item, arrived_ns, _ in received:
        assert item != made.item or arrived_ns >= START_NS
    times = [arrived_ns for _, arrived_ns, _ in received]
    assert times == sorted(times)


@fuzz
@given(streams(), disturbances())
@settings(max_examples=examples(60))
def test_no_value_becomes_garbage(stream: list[Message], made: Disturbance) -> None:
    """Types and lengths stay, no number becomes NaN or infinite, whole ones fit into 64 bits."""
    shapes = {item: shape(fields) for item, _, fields in stream}
    for item, _, fields in disturb(stream, [made], START_NS):
        assert shape(fields) == shapes[item]
    before = Counter(repr(v) for m in stream for v in leaves(m[2]) if is_odd(v))
    odd = [v for m in disturb(stream, [made], START_NS) for v in leaves(m[2]) if is_odd(v)]
    assert {repr(value) for value in odd} <= set(before)


def shape(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: shape(each) for key, each in value.items()}
    if isinstance(value, list):
        return [shape(each) for each in value]
    return type(value)


def leaves(value: Any) -> list[Any]:
    if isinstance(value, dict):
        value = list(value.values())
    if isinstance(value, list):
        return [leaf for each in value for leaf in leaves(each)]
    return [value]


def is_odd(value: Any) -> bool:
    if isinstance(value, float):
        return not math.isfinite(value)
    return isinstance(value, int) and not -(2**63) <= value < 2**63


@fuzz
@given(streams(), st.lists(disturbances(), max_size=3), st.lists(st.integers(1, 30), max_size=8))
@settings(max_examples=examples(40))
def test_pieces_and_heads_of_a_stream_give_the_same(
    stream: list[Message], made: list[Disturbance], cuts: list[int]
) -> None:
    """The same seed gives the same stream in any pieces, and nothing depends on what comes."""
    whole = list(disturb(stream, made, START_NS, 7))
    disturber = Disturber(made, START_NS, 7)
    pieces: list[Message] = []
    rest = list(stream)
    for cut in cuts:
        pieces += disturber.feed(rest[:cut])
        rest = rest[cut:]
    so_far = list(pieces)
    pieces += [*disturber.feed(rest), *disturber.flush()]
    assert same(pieces, whole)
    assert same(so_far, whole[: len(so_far)])


# -- what each kind does


def ramp() -> list[Message]:
    """Ten messages a second for 6 s; ``x`` counts them, ``y`` is its square."""
    return [
        (
            "item",
            START_NS + n * STEP_NS,
            {"v": {"x": float(n), "y": float(n * n), "n": n, "l": [1.0, 2.0, n]}, "on": n % 2 == 0},
        )
        for n in range(60)
    ]


def inside(received: Sequence[Message]) -> list[Any]:
    return [fields["v"] for _, time_ns, fields in received if is_inside(time_ns)]


@pytest.mark.parametrize(
    ("text", "x"),
    [
        ("scale:item.v.x=3", [3.0 * n for n in range(20, 40)]),
        ("offset:item.v.x=-5", [n - 5.0 for n in range(20, 40)]),
        ("drift:item.v.x=2", [n + 0.2 * (n - 20) for n in range(20, 40)]),
        ("sign:item.v.x", [-float(n) for n in range(20, 40)]),
        ("mirror:item.v.x=30", [60.0 - n for n in range(20, 40)]),
        ("mirror:item.v.x", [40.0 - n for n in range(20, 40)]),
        ("quantise:item.v.x=8", [8.0 * round(n / 8) for n in range(20, 40)]),
        ("unit:item.v.x=celsius_to_fahrenheit", [1.8 * n + 32 for n in range(20, 40)]),
        ("unit:item.v.x=rad_to_deg", [math.degrees(n) for n in range(20, 40)]),
        ("freeze:item.v.x", [19.0] * 20),
        ("delay:item.v.x=0.5", [n - 5.0 for n in range(20, 40)]),
        ("swap:item.v.x=v.y", [float(n * n) for n in range(20, 40)]),
    ],
)
def test_what_becomes_of_a_value(text: str, x: list[float]) -> None:
    stream = ramp()
    received = sent_with(stream, text)
    assert [v["x"] for v in inside(received)] == pytest.approx(x)
    other = "n" if text.startswith("swap") else "y"
    assert [v[other] for v in inside(received)] == [v[other] for v in inside(stream)]


def test_whole_numbers_lists_and_elements() -> None:
    stream = ramp()
    assert [v["n"] for v in inside(sent_with(stream, "scale:item.v.n=0.5"))] == [
        round(n / 2) for n in range(20, 40)
    ]
    assert inside(sent_with(stream, "mirror:item.v.l"))[0]["l"] == [20, 2.0, 1.0]
    assert inside(sent_with(stream, "offset:item.v.l[1]=1"))[0]["l"] == [1.0, 3.0, 20]
    assert inside(sent_with(stream, "offset:item.v=1"))[0] == {
        "x": 21.0,
        "y": 401.0,
        "n": 21,
        "l": [2.0, 3.0, 21],
    }
    assert same(sent_with(stream, "scale:item.on=3"), stream)


def test_swapped_values_change_places_and_only_with_the_same_type() -> None:
    stream = ramp()
    assert [(v["x"], v["y"]) for v in inside(sent_with(stream, "swap:item.v.x=v.y"))] == [
        (float(n * n), float(n)) for n in range(20, 40)
    ]
    assert same(sent_with(stream, "swap:item.v.x=v.n"), stream)
    units = {"a": {"p": 1.0, "q": [1.0]}, "b": {"p": 2.0, "q": [2.0]}, "c": {"p": 3.0}}
    stream = [("units", START_NS + n * STEP_NS, units) for n in range(60)]
    assert sent_with(stream, "swap:units.a=b")[30][2] == {
        "a": units["b"], "b": units["a"], "c": units["c"]
    }  # fmt: skip
    assert same(sent_with(stream, "swap:units.a=c"), stream)


def arrivals(received: Sequence[Message]) -> list[tuple[float, int]]:
    """Return when each message came, in seconds, with its number."""
    return [((time_ns - START_NS) / NS, fields["v"]["n"]) for _, time_ns, fields in received]


def test_delayed_messages_come_later_in_order_of_arrival() -> None:
    came = arrivals(sent_with(ramp(), "delay:item=0.45"))
    expected = sorted((n / 10 + (0.45 if 20 <= n < 40 else 0.0), n) for n in range(60))
    assert [n for _, n in came] == [n for _, n in expected]
    assert [at_s for at_s, _ in came] == pytest.approx([at_s for at_s, _ in expected])


@pytest.mark.parametrize("seed", range(5))
def test_jitter_delays_by_up_to_its_amount_and_keeps_the_order(seed: int) -> None:
    came = [each for each in arrivals(sent_with(ramp(), "jitter:item=0.3", seed)) if each[1] < 40]
    late_s = [at_s - n / 10 for at_s, n in came if n >= 20]
    assert [n for _, n in came] == list(range(40))
    assert all(-1e-9 <= late <= 0.3 + 1e-9 for late in late_s) and len(set(late_s)) > 10


def test_dropped_messages_are_missing() -> None:
    assert [n for _, n in arrivals(sent_with(ramp(), "drop:item"))] == [*range(20), *range(40, 60)]
    lost = []
    for seed in range(40):
        left = [n for _, n in arrivals(sent_with(ramp(), "drop:item=0.25", seed))]
        assert set(left) >= {*range(20), *range(40, 60)}
        lost.append(60 - len(left))
    assert sum(lost) / 40 / 20 == pytest.approx(0.25, abs=0.08)


def test_repeated_messages_come_again_at_once() -> None:
    received = sent_with(ramp(), "repeat:item=2")
    assert Counter(n for _, n in arrivals(received)) == {
        n: 3 if 20 <= n < 40 else 1 for n in range(60)
    }
    assert [n for _, n in arrivals(received)] == sorted(n for _, n in arrivals(received))


def test_types_of_numpy_stay() -> None:
    row: dict[str, Any] = {"a": np.float32(2.0), "b": np.int8(100), "c": np.array([1, 2], np.uint8)}
    stream = [("row", START_NS + n * STEP_NS, row) for n in range(60)]
    for path, value in (("a", 4.0), ("b", 127), ("c", [2, 4])):
        got = sent_with(stream, f"scale:row.{path}=2")[30][2][path]
        assert got.dtype == row[path].dtype and got.tolist() == value


def test_it_counts_what_it_has_changed() -> None:
    texts = ["scale:item.v.x", "scale:item.absent", "drop:item=0", "swap:item.v.x=v.n"]
    disturber = Disturber([parse_disturbance(text) for text in texts], START_NS)
    assert len(list(disturber.feed(ramp()))) == 60
    assert disturber.touched == [60, 0, 0, 0]


# -- random disturbances


@pytest.fixture(scope="module")
def said() -> list[Message]:
    """What a simulated robot says in 15 s."""
    return list(Robot(11).step_until(15.0))


@pytest.fixture(scope="module")
def variables(said: list[Message]) -> list[Variable]:
    return simulated_variables(said)


def test_the_survey_knows_types_units_codes_and_values(variables: list[Variable]) -> None:
    found = {f"{each.item}.{each.path}": each for each in variables}
    assert not any(".header" in address for address in found)
    battery = found["battery.temperature"]
    assert (battery.kind, battery.unit) == ("number", "°C") and 10 < battery.low < battery.high
    assert found["wheels.sensors.front_left.status1"].kind == "code"
    assert found["battery.charging"].kind == "flag"
    assert found["battery.cell_voltage"].kind == "numbers"
    assert found["nodes.navigation.pid"].kind == "integer"
    assert found["state.mode"].kind == "text"


def test_a_survey_of_odd_values() -> None:
    rows: list[Message] = [("i", n, {"nan": math.nan, "none": None, "l": [True]}) for n in range(3)]
    assert survey(rows) == [Variable("i", "nan", "number")]
    with pytest.raises(UsageError, match="no variable"):
        draw(1, survey(rows[:0]))


def test_draws_are_even_over_kinds_repeatable_and_valid(variables: list[Variable]) -> None:
    drawn = [draw(seed, variables, 5.0, 9.0) for seed in range(650)]
    assert drawn == [draw(seed, variables, 5.0, 9.0) for seed in range(650)]
    kinds = Counter(each.kind for each in drawn)
    assert set(kinds) == set(KINDS) and all(25 < count < 80 for count in kinds.values())
    assert [each for each in drawn if [*each.check(), *address_problems(each)]] == []
    known = {(each.item, each.path): each for each in variables}
    counted = [d for d in drawn if d.variable and d.kind not in ("swap", "freeze", "delay")]
    assert all(known[d.item, d.variable].is_number for d in counted)
    assert len({(d.item, d.variable) for d in counted}) > 120
    assert all(parse_disturbance(str(d)).kind == d.kind for d in drawn)


def test_drawn_disturbances_change_the_stream(
    said: list[Message], variables: list[Variable]
) -> None:
    often = [each for each in variables if each.item not in ("log", "tasks")]
    for seed in range(60):
        disturber = Disturber([draw(seed, often, 2.0)], Robot(11).start_ns)
        assert len(list(disturber.feed(said))) > 0
        assert disturber.touched[0] > 0, str(disturber.disturbances[0])


# -- descriptions


def test_a_file_of_disturbances(tmp_path: Path) -> None:
    path = tmp_path / "d.yaml"
    path.write_text(
        "disturbances:\n"
        "  - {kind: swap, item: battery, variable: voltage, other: charger_voltage, at_s: 20}\n"
        "  - {kind: delay, item: odom, amount: 0.4, until_s: 1 min}\n"
    )
    assert load_disturbances(path) == (
        Disturbance("swap", "battery", "voltage", other="charger_voltage", at_s=20.0),
        Disturbance("delay", "odom", amount=0.4, until_s=60.0),
    )


@pytest.mark.parametrize(
    ("entry", "part"),
    [
        ("{kind: swop, item: odom}", "did you mean 'swap'"),
        ("{kind: scale, item: odom}", "scale needs a variable"),
        ("{kind: drop, item: odom, variable: x}", "takes no variable"),
        ("{kind: drop, item: odom, amount: 1.5}", "must lie from 0 to 1"),
        ("{kind: sign, item: odom, variable: x, amount: 2}", "has no amount"),
        ("{kind: scale, item: odom, variable: x, amount: .inf}", "must be finite"),
        ("{kind: swap, item: odom, variable: x, other: x}", "needs another variable"),
        ("{kind: sign, item: odom, variable: 'x[a]'}", "must be a path"),
        ("{kind: sign, item: odom, variable: x, other: y}", "is for swap only"),
        ("{kind: unit, item: odom, variable: x, conversion: rad_to_dog}", "'rad_to_deg'"),
        ("{kind: drop, item: odom, at_s: 5, until_s: 5}", "must be later than at_s"),
    ],
)
def test_wrong_files_are_refused_with_the_line(entry: str, part: str, tmp_path: Path) -> None:
    path = tmp_path / "d.yaml"
    path.write_text(f"disturbances:\n  - {entry}\n")
    with pytest.raises(ConfigurationError) as caught:
        load_disturbances(path)
    assert f"{path}:2" in str(caught.value) and part in str(caught.value)


@pytest.mark.parametrize(
    ("text", "part"),
    [
        ("nonsense", "cannot read"),
        ("scala:odom.x", "did you mean 'scale'"),
        ("scale:odom.x=much", "could not convert"),
        ("scale:odom.x=2@soon", "soon"),
        ("scale:odom", "needs a variable"),
        ("scale:odom.x=2@5s..4s", "later than at_s"),
    ],
)
def test_unreadable_texts_are_refused(text: str, part: str) -> None:
    with pytest.raises(UsageError, match=part):
        parse_disturbance(text)


def test_places_that_the_robot_does_not_have() -> None:
    wrong = ["drop:odum", "sign:odom.twist.liniar.x", "swap:battery.voltage=curent"]
    found = [what for text in wrong for _, what in address_problems(parse_disturbance(text))]
    assert [what.split("?")[0].split("did you mean ")[1] for what in found] == [
        "'odom'",
        "'twist.linear.x'",
        "'current'",
    ]


# -- the live robot


class _Wire:
    def __init__(self) -> None:
        self.sent: list[list[bytes]] = []

    def send_multipart(self, msg_parts: list[bytes]) -> None:
        self.sent.append(msg_parts)


def test_the_live_robot_says_what_was_disturbed() -> None:
    def run(texts: Sequence[str]) -> list[list[bytes]]:
        robot, wire = Robot(5), _Wire()
        disturber = Disturber([parse_disturbance(t) for t in texts], robot.start_ns)
        publish(
            robot, wire, LiveRun("max", 2.0), queue.SimpleQueue(), threading.Event(),
            disturber=disturber,
        )  # fmt: skip
        return wire.sent

    usual, changed = run([]), run(["offset:battery.temperature=100@1s", "drop:odom@0s..1s"])
    hot = [json.loads(data)["temperature"] > 90 for topic, data in changed if topic == b"battery"]
    assert hot == [False, False, True, True]
    odom = [json.loads(data)["header"]["seq"] for topic, data in changed if topic == b"odom"]
    assert odom == list(range(51, 101))
    rest = [each for each in usual if each[0] not in (b"battery", b"odom")]
    assert [each for each in changed if each[0] not in (b"battery", b"odom")] == rest


def test_the_command_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("zmq")
    monkeypatch.setattr("sys.stdin", io.StringIO())
    monkeypatch.setattr("amberbox.sim.__main__._SURVEY_S", 3.0)
    path, truth = tmp_path / "d.yaml", tmp_path / "truth.jsonl"
    path.write_text("disturbances: [{kind: drop, item: imu}]\n")
    run = ["--zmq", "tcp://127.0.0.1:*", "--for", "1s", "--speed", "max", "--truth", str(truth)]
    assert main([*run, "--disturbances", str(path), "--disturb", "random=3@500ms"]) == 0
    topics = {json.loads(line)["topic"] for line in truth.read_text().splitlines()}
    assert "odom" in topics and "imu" not in topics
    drawn = draw("3", simulated_variables(Robot(1).step_until(3.0)), 0.5)
    assert f"disturbance {drawn}\n" in capsys.readouterr().err
    assert main([*run, "--disturb", "drop:odum"]) == 2
    assert "did you mean 'odom'" in capsys.readouterr().err


def test_the_kinds_print_as_table_and_json(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["--list-disturbances"]) == 0
    table = capsys.readouterr().out
    assert main(["--list-disturbances", "--json"]) == 0
    listed = json.loads(capsys.readouterr().out)
    assert list(listed["kinds"]) == list(KINDS) and list(listed["conversions"]) == list(CONVERSIONS)
    assert all(name in table for name in [*KINDS, *CONVERSIONS])
