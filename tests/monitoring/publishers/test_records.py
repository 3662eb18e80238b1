"""Findings are encoded as records and decoded without change; equal findings give equal bytes."""

from __future__ import annotations

import math
import time
from pathlib import Path
from typing import Any, get_args

import msgspec
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from amberbox.blackbox.columns.table_text import plain
from amberbox.blackbox.journal import channels
from amberbox.blackbox.store.derived_journal import DerivedJournal
from amberbox.blackbox.store.store import create_store
from amberbox.blackbox.store.tail import follow
from amberbox.core.robot_status import Severity
from amberbox.core.types import (
    AmbiguityGroup,
    Batch,
    Diagnosis,
    Hypothesis,
    Level,
    Status,
    Symptom,
    SymptomState,
)
from amberbox.core.types import Test as Proposal
from amberbox.monitoring.findings import (
    AlarmChange,
    AlarmState,
    Finding,
    HealthState,
    Transition,
    encoded,
    finding_of,
    record_of,
    status_of,
)

TEXT = st.text(st.characters(exclude_categories=["Cs"]), max_size=8)
TIMES = st.integers(0, 2**62)
LEVELS = st.sampled_from(get_args(Level))
VALUES = st.none() | st.booleans() | st.integers(-(2**53), 2**53) | st.floats() | TEXT
CONDITIONS = st.builds(HealthState, LEVELS, TEXT)
BLOCKED = st.lists(TEXT, max_size=2).map(tuple)
STATUSES = st.builds(
    Status,
    *(TEXT, TEXT, TEXT, LEVELS, TEXT, st.dictionaries(TEXT, VALUES, max_size=4), BLOCKED),
    *(TIMES, TIMES, TEXT, TEXT, st.booleans()),
)
TRANSITIONS = st.builds(
    Transition,
    *(TEXT, TEXT, TEXT, CONDITIONS, CONDITIONS, TIMES, TEXT, BLOCKED, TEXT, TEXT, st.booleans()),
)
ALARMS = st.builds(
    AlarmChange,
    *(TEXT, TEXT, TEXT, st.sampled_from(get_args(Severity)), st.sampled_from(get_args(AlarmState))),
    *(LEVELS, TEXT, TIMES, TIMES, st.integers(0, 9), TEXT, st.none() | TIMES, TEXT, st.booleans()),
)
TEXTS = st.lists(TEXT, max_size=3).map(tuple)
NUMBERS = st.floats(allow_nan=False, allow_infinity=False)
SYMPTOMS = st.builds(
    Symptom,
    *(TEXT, st.sampled_from(get_args(SymptomState)), TEXT, st.none() | TIMES, st.none() | TIMES),
    *(NUMBERS, TEXT, st.lists(st.tuples(TEXT, TIMES, TIMES), max_size=3).map(tuple), TEXTS),
)
HYPOTHESES = st.builds(
    Hypothesis,
    *(TEXT, st.frozensets(TEXT, max_size=3), NUMBERS, TEXTS, TEXTS, TEXTS, TEXTS, TEXT, NUMBERS),
)
KINDS = ("read", "question", "check", "experiment", "unit_test")
TESTS = st.builds(
    Proposal,
    *(TEXT, st.sampled_from(KINDS), TEXT, TEXT, NUMBERS, NUMBERS, NUMBERS),
    st.dictionaries(TEXT, NUMBERS, max_size=3),
)
GROUPS = st.builds(AmbiguityGroup, TEXTS, NUMBERS, TEXTS, TEXT)
DIAGNOSES = st.builds(
    Diagnosis,
    *(TEXT, st.integers(0, 99), TEXT, TIMES, TEXT, st.lists(HYPOTHESES, max_size=3).map(tuple)),
    *(NUMBERS, TEXT, TEXTS, st.lists(TESTS, max_size=2).map(tuple)),
    *(st.lists(GROUPS, max_size=2).map(tuple), TEXTS, st.sampled_from(["open", "healed"])),
    st.booleans(),
)
STATUS = Status(
    *("ropod_001", "laser", "laser_device", "error", "front_laser_working"),
    {"front_laser_working": False, "rate": 12.5, "count": 3, "mode": "auto", "seen": None},
    *(("ethercat",), 2_000_000_000, 1_000_000_000),
    *("front_laser_working is false, expected true", "abc"),
)


@given(STATUSES | TRANSITIONS | ALARMS | SYMPTOMS | DIAGNOSES)
def test_finding_comes_back_as_it_was(finding: Finding) -> None:
    channel, data = encoded(finding)
    values = msgspec.json.decode(data)
    again = finding_of(channel, values)
    if isinstance(finding, Diagnosis | Symptom):
        assert again == finding
    else:
        assert repr(again) == repr(finding)  # NaN equals NaN in text
    assert encoded(again or finding) == (channel, data)


@given(STATUSES | TRANSITIONS | ALARMS | SYMPTOMS | DIAGNOSES)
def test_record_has_the_keys_of_the_published_schema(finding: Finding) -> None:
    channel, data = encoded(finding)
    schema = msgspec.json.decode(channels.schema_of(channel).data)
    values = msgspec.json.decode(data)
    assert list(values) == list(schema["properties"])


def test_status_is_written_as_documented() -> None:
    channel, values = record_of(STATUS)
    assert channel == "amberbox/status"
    assert values["outputs"] == [
        {"name": "front_laser_working", "type": "bool", "value": 0, "text": None},
        {"name": "rate", "type": "float", "value": 12.5, "text": None},
        {"name": "count", "type": "int", "value": 3, "text": None},
        {"name": "mode", "type": "string", "value": None, "text": "auto"},
        {"name": "seen", "type": "null", "value": None, "text": None},
    ]


def test_numbers_of_numpy_are_plain_numbers() -> None:
    outputs = {"b": np.bool_(True), "i": np.int16(-4), "f": np.float32(0.5), "d": np.float64("nan")}
    status = _with_outputs(outputs)
    again = status_of(msgspec.json.decode(encoded(status)[1]))
    assert again.outputs["b"] is True
    assert again.outputs["i"] == -4
    assert again.outputs["f"] == 0.5
    assert math.isnan(float(again.outputs["d"] or 0))


def test_output_that_is_no_value_is_refused() -> None:
    with pytest.raises(TypeError, match="output b: list is no bool, number or text"):
        encoded(_with_outputs({"b": [1]}))


def _with_outputs(outputs: dict[str, Any]) -> Status:
    return Status("r", "c", "m", "ok", "nominal", outputs, (), 2, 1, "", "")


def test_other_events_are_no_findings() -> None:
    assert finding_of(channels.EVENT, {"kind": "started"}) is None
    assert finding_of(channels.COUNTERS, {"items": []}) is None


def test_journal_gives_back_what_was_written(tmp_path: Path) -> None:
    store = create_store(tmp_path / "store")
    journal = DerivedJournal(store, "watch")
    journal.write([record_of(STATUS)])
    journal.close()
    found = follow(store.path, ["amberbox_status"], live=False, writers=["watch"])
    (batch,) = (delivery for delivery in found if isinstance(delivery, Batch))
    outputs = batch.children["outputs"].columns
    assert plain(batch.columns["level"]) == ["error"]
    assert plain(outputs["name"]) == list(STATUS.outputs)
    assert plain(outputs["value"])[:3] == [0.0, 12.5, 3.0]


SYMPTOM = Symptom(
    *("laser/device/working", "present", "laser/device/working", 1_000_000_000, 2_000_000_000),
    evidence=(("ros_scan.ranges[17]", 1_000_000_000, 2_000_000_000), ("ros_odom", 1, 2)),
    blocked_by=("bus",),
)
DIAGNOSIS = Diagnosis(
    *("ropod-20260101t000000", 3, "ropod_001", 2_000_000_000, "abc"),
    (Hypothesis("h1", frozenset({"laser#dead", "bus#cut"}), 0.75, explains=(SYMPTOM.id,)),),
    *(0.99, "", ("wheel#odd",)),
    (Proposal("look", "check", "Look at it", outcomes={"yes": 0.75, "no": 0.25}),),
    (AmbiguityGroup(("h1", "h2"), 0.9, split_by="look"),),
    (SYMPTOM.id,),
)


def test_symptom_and_diagnosis_are_rows_of_the_journal(tmp_path: Path) -> None:
    store = create_store(tmp_path / "store")
    journal = DerivedJournal(store, "watch")
    journal.write([record_of(SYMPTOM), record_of(DIAGNOSIS)])
    journal.close()
    items = ["amberbox_symptom", "amberbox_diagnosis"]
    found = follow(store.path, items, live=False, writers=["watch"])
    batches = {d.item: d for d in found if isinstance(d, Batch)}
    symptom, diagnosis = (batches[item] for item in items)
    assert plain(symptom.columns["state"]) == ["present"]
    assert plain(symptom.columns["onset_ns"]) == [1_000_000_000]
    evidence = symptom.children["evidence"].columns
    assert plain(evidence["address"]) == ["ros_scan.ranges[17]", "ros_odom"]
    assert plain(diagnosis.columns["state"]) == ["open"]
    assert plain(diagnosis.children["hypotheses"].columns["probability"]) == [0.75]
    outcomes = diagnosis.children["next_tests"].children["outcomes"].columns
    assert plain(outcomes["answer"]) == ["yes", "no"]


def test_failure_modes_of_a_hypothesis_are_written_in_order() -> None:
    _, values = record_of(DIAGNOSIS)
    assert values["hypotheses"][0]["faults"] == ["bus#cut", "laser#dead"]


def test_writing_a_status_costs_little() -> None:
    started = time.process_time()
    for _ in range(2000):
        encoded(STATUS)
    per_status_s = (time.process_time() - started) / 2000
    assert per_status_s < 40e-6, "a replay writes millions; it takes 3 us on an idle machine"
