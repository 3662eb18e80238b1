from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from amberbox.core.clock import NS
from amberbox.core.types import Batch, Column, ItemSchema, Ragged, Symptom
from amberbox.diagnosis.evidence.conditions import AddressColumns, ConditionTracker
from tests.diagnosis.tracker.robot import T0_NS, knowledge, rows, seconds, status

TEXT = """\
types:
  part:
    failure_modes:
      broken: {probability: 0.01, symptoms: [seen]}
symptoms:
  seen: {when: "CONDITION"}
"""


def conditions(text: str) -> ConditionTracker:
    """Return the conditions of an analysis with one."""
    made = ConditionTracker(knowledge(TEXT.replace("CONDITION", text)).fmea)
    assert made.begin(T0_NS) == []
    return made


def times(until_s: float, rate_hz: float = 10.0) -> list[float]:
    """Return instants from the first one after the beginning on."""
    return [i / rate_hz for i in range(1, round(until_s * rate_hz) + 1)]


def told(found: Sequence[Symptom]) -> list[tuple[float, str]]:
    """Return when it became what."""
    return [(((one.confirmed_ns or 0) - T0_NS) / NS, one.state) for one in found]


def advance(made: ConditionTracker, until_s: float, step_s: float = 0.0) -> list[tuple[float, str]]:
    """Go on from the beginning, all at once or in steps."""
    ends = np.arange(step_s, until_s, step_s).tolist() if step_s else []
    found, after_ns = list[Symptom](), T0_NS
    for end_s in [*ends, until_s]:
        found += made.advance(after_ns, seconds(end_s))
        after_ns = seconds(end_s)
    return told(found)


def test_tells_when_it_changes_at_quarters_of_a_second() -> None:
    made = conditions("x.a > 5")
    assert made.items == {"x"}
    made.feed(rows("x", times(3), a=[9.0 if 1.1 <= at < 2.05 else 0.0 for at in times(3)]))
    found = made.advance(T0_NS, seconds(3))
    assert told(found) == [(0.25, "absent"), (1.25, "present"), (2.25, "absent")]
    there = found[1]
    assert (there.id, there.address, there.source, there.strength) == (
        "seen",
        "x.a",
        "condition",
        1,
    )
    assert there.onset_ns == there.confirmed_ns == seconds(1.25)
    assert there.evidence == (("x.a", seconds(1.25), seconds(1.25)),)
    assert found[0].onset_ns is None and found[0].evidence == ()


def test_what_holds_for_some_time_began_that_long_before() -> None:
    made = conditions("x.a > 5 for 1s")
    made.feed(rows("x", times(3), a=[9.0 if at >= 1 else 0.0 for at in times(3)]))
    found = made.advance(T0_NS, seconds(3))
    assert told(found)[-1] == (2.0, "present")
    assert (found[-1].onset_ns, found[-1].confirmed_ns) == (seconds(1), seconds(2))


def test_what_is_older_than_five_seconds_is_unknown() -> None:
    made = conditions("x.a > 5")
    made.feed(rows("x", [1.0], a=[9.0]))
    assert advance(made, 20) == [(1.0, "present"), (6.25, "unknown")]


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("age(x.a) > 7", [(1.0, "absent"), (8.25, "present")]),
        ("count(x.a over 8s) < 1", [(0.25, "present"), (1.0, "absent"), (9.0, "present")]),
        ("not known(x.a)", [(0.25, "present"), (1.0, "absent")]),
        ("mean(x.a over 8s) > 5", [(1.0, "present"), (6.25, "unknown")]),
    ],
)
def test_what_asks_for_silence_need_not_be_fresh(
    text: str, expected: list[tuple[float, str]]
) -> None:
    made = conditions(text)
    made.feed(rows("x", [1.0], a=[9.0]))
    assert advance(made, 20) == expected


def test_null_is_unknown() -> None:
    made = conditions("x.a > 5")
    masked = np.ma.MaskedArray([9.0, 9.0, 0.0], [False, True, False])
    made.feed(rows("x", [1.0, 2.0, 3.0], a=masked))
    assert advance(made, 4) == [(1.0, "present"), (2.0, "unknown"), (3.0, "absent")]


def test_a_column_that_is_not_there_is_unknown() -> None:
    made = conditions("x.b > 5")
    made.feed(rows("x", times(3), a=np.zeros(30)))
    assert advance(made, 3) == []


def test_values_of_monitors_come_from_statuses() -> None:
    made = conditions("motor/drive/state == 'slow' and motor/drive/turns_hz < 3")
    assert made.items == frozenset()
    for at in range(1, 6):
        made.take(status(at, "motor", "drive", state="slow" if at > 2 else "fast", turns_hz=at))
        made.take(status(at, "motor", "other", state="slow", turns_hz=0))
    made.take(status(6, "motor", "drive", state=None, turns_hz=None))
    assert advance(made, 8) == [(1.0, "absent"), (6.0, "unknown")]
    made = conditions("motor/drive/warm == false")
    made.take(status(1.1, "motor", "drive", warm=True))
    made.take(status(2.1, "motor", "drive", warm=False))
    assert advance(made, 3) == [(1.25, "absent"), (2.25, "present")]


def test_reads_an_element_of_a_list() -> None:
    made = conditions("scan.ranges[1] < 0.5")
    ranges = Ragged(np.array([0, 3, 6, 7]), np.array([1, 0.1, 1, 1, 0.9, 1, 1]))
    made.feed(rows("scan", [1.0, 2.0, 3.0], ranges=ranges))
    assert advance(made, 4) == [(1.0, "present"), (2.0, "absent"), (3.0, "unknown")]


def test_reads_a_row_of_a_list_of_structures() -> None:
    made = conditions("state__wheels.speed[1] > 5")
    assert made.items == {"state", "state__wheels"}
    wheels = rows("state__wheels", [1.0, 1.0, 2.0, 2.0, 3.0], speed=[0, 9.0, 0, 1, 9.0],
                  index=[0, 1, 0, 1, 0], parent_seq=[0, 0, 1, 1, 2])  # fmt: skip
    made.feed(_with_child(rows("state", [1.0, 2.0, 3.0], a=np.zeros(3)), wheels))
    assert advance(made, 4) == [(1.0, "present"), (2.0, "absent"), (3.0, "unknown")]
    made = conditions("state__names.name[0] == 'b'")
    names = rows("state__names", [1.0, 2.0], name=np.array(["a", "b"], object), index=[0, 0],
                 parent_seq=[0, 1])  # fmt: skip
    made.feed(_with_child(rows("state", [1.0, 2.0], a=np.zeros(2)), names))
    assert advance(made, 4) == [(1.0, "absent"), (2.0, "present")]


def _with_child(batch: Batch, child: Batch) -> Batch:
    schema = ItemSchema("state", (Column("a", "a", "float64"),))
    return Batch(batch.item, schema, "main", 1, batch.seq, batch.log_time_ns, batch.received_ns,
                 batch.timestamp_ns, batch.columns, {"child": child})  # fmt: skip


@pytest.mark.parametrize("step_s", [0.0, 0.3])
def test_a_value_of_a_wrong_type_is_unknown_and_says_why(step_s: float) -> None:
    made = conditions("x.a > 5")
    made.feed(rows("x", times(3), a=np.array(["text"] * 30, object)))
    assert advance(made, 3, step_s) == []
    assert "cannot compare" in made.troubles["seen"]
    made.feed(rows("x", [3.1], a=np.array([9.0])))
    assert told(made.advance(seconds(3), seconds(4))) == [(3.25, "present")]
    assert made.troubles == {}


def test_a_number_is_true_unless_it_is_zero() -> None:
    made = conditions("x.flag")
    made.feed(rows("x", [1.0, 2.0, 3.0], flag=np.array([0, 1, 0], np.uint8)))
    assert advance(made, 4) == [(1.0, "absent"), (2.0, "present"), (3.0, "absent")]


@pytest.mark.parametrize(
    "text",
    [
        "x.a > 0.5",
        "mean(x.a over 2s) > 0.1",
        "std(x.a over 1s) > 0.4 for 500ms",
        "age(y.b) > 0.4 or x.a > 0.9",
        "rate(x.a over 500ms) > y.b",
    ],
)
def test_many_instants_at_once_give_the_same_as_one_by_one(text: str) -> None:
    rng = np.random.default_rng(5)
    x = rows("x", times(20, 20), a=np.sin(np.arange(400) / 10) + rng.normal(0, 0.2, 400))
    y_times = np.sort(rng.uniform(0, 20, 50)).tolist()
    y = rows("y", y_times, b=rng.normal(size=50))
    found = []
    for step_s in (0.0, 0.1, 0.25, 1.7):
        made = conditions(text)
        for batch in (x, y):
            made.feed(batch)
        found.append(advance(made, 20, step_s))
    assert all(one == found[0] for one in found) and len(found[0]) > 4


def test_an_epoch_makes_unknown_what_was_known() -> None:
    made = conditions("x.a > 5")
    made.feed(rows("x", times(3), a=np.full(30, 9.0)))
    advance(made, 3)
    assert told(made.begin(seconds(-5))) == [(-5.0, "unknown")]
    assert made.begin(seconds(-5)) == []
    made.feed(rows("x", [-4.0], a=np.zeros(1)))
    assert told(made.advance(seconds(-5), seconds(-2))) == [(-4.0, "absent")]


@pytest.mark.parametrize("value", [9.0, float("nan"), float("inf"), 3, True, "text", None])
@pytest.mark.parametrize("more_s", [0.0, 7.0])
def test_goes_on_from_a_snapshot_with_rows_fed_again(value: Any, more_s: float) -> None:
    text = "(known(x.a) and (y.b > 5 for 3s)) or motor/drive/warm"
    array = np.array([value], object if value is None or isinstance(value, str) else None)
    one, other = conditions(text), conditions(text)
    rows_y = rows("y", times(30), b=[9.0 if at > 20 else 0.0 for at in times(30)])
    for made in (one, other):
        made.feed(rows("x", [1.0], a=array))  # long before all that will be fed again
        for at in range(25):
            made.take(status(at + 0.1, "motor", "drive", warm=at == 20))
    one.feed(rows_y)
    other.feed(rows("y", times(21), b=[9.0 if at > 20 else 0.0 for at in times(21)]))
    assert one.advance(T0_NS, seconds(21)) == other.advance(T0_NS, seconds(21))
    again = conditions(text)
    again.resume(json.loads(json.dumps(other.snapshot(seconds(21)), allow_nan=False)), seconds(21))
    since = [at for at in times(30) if at >= 21 - other.history_s - more_s]
    again.feed(rows("y", since, b=[9.0 if at > 20 else 0.0 for at in since]))
    later = one.advance(seconds(21), seconds(30))
    assert again.advance(seconds(21), seconds(30)) == later != []


def test_rows_that_are_held_already_are_not_taken_twice() -> None:
    made, again = (AddressColumns(["x.a", "x.list[1]"], 6 * NS) for _ in range(2))
    made.feed(rows("x", times(20), a=np.zeros(200)))
    again.resume(json.loads(json.dumps(made.snapshot(seconds(20)))))
    again.feed(rows("x", times(20), a=np.zeros(200)))
    for name, samples in again.samples().items():
        assert samples.times_ns.tolist() == [seconds(at) for at in times(20) if at >= 14], name


def test_levels_of_modes_and_components_come_from_statuses() -> None:
    made = conditions("status(motor/drive) == 'ok' and status(motor) != 'error'")
    for at in range(1, 4):
        made.take(status(at, "motor", "drive"))
        made.take(replace(status(at, "motor", ""), level="ok" if at < 3 else "error"))
    assert advance(made, 4) == [(1.0, "present"), (3.0, "absent")]
