"""Entries of DiagnosticArray: the worst counts, and one that is missing is stale."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import pytest

from amberbox.core.mode import UNKNOWN, Input
from amberbox.monitoring.modes import diagnostics as mode
from amberbox.monitoring.modes.diagnostics import Config
from amberbox.testing.modes import assert_mode_contract, at_s, one_input

BOTH = Config(names=("^imu", "^laser"))

Row = tuple[float, Any, Any, Any]


def arrays(*rows: Row) -> Input:
    """Make the rows of arrays: second, name, level, message."""
    times, names, levels, messages = zip(*rows, strict=True)
    parts: dict[str, Sequence[Any]] = {"name": names, "level": levels, "message": messages}
    return one_input("ros_diagnostics__status", times_s=times, parts=parts)


def judged(config: Config, entry: Input, second: float) -> tuple[Any, Any, Any]:
    found = mode.evaluate(config, [entry], at_s(second))
    return found["ok"], found.get("level"), found.get("message")


def test_contract() -> None:
    parts = {"name": "string", "level": "int", "message": "string"}
    configs = [Config(names=("",)), Config(names=("ok", "error"), worst="warn", max_age=1.0)]
    assert_mode_contract(mode, "diagnostics", configs=configs, parts=parts)


def test_the_worst_of_the_newest_entries_counts() -> None:
    entry = arrays(
        (0, "imu", 0, "fine"), (0, "laser: rate", 0, "10 Hz"), (0, "battery", 2, "empty"),
        (1, "imu", 1, "noisy"), (1, "laser: rate", 0, "10 Hz"), (1, "laser: motor", 2, "stuck"),
        (2, "imu", 0, "fine"), (2, "laser: rate", 0, "10 Hz"), (2, "laser: motor", 0, "turns"),
    )  # fmt: skip
    assert judged(BOTH, entry, 0)[:2] == (True, 0)
    assert judged(BOTH, entry, 1) == (False, 2, "laser: motor: stuck")
    assert judged(Config(names=("^imu",)), entry, 1) == (False, 1, "imu: noisy")
    assert judged(Config(names=("^imu",), worst="warn"), entry, 1)[0] is True
    assert judged(BOTH, entry, 2)[:2] == (True, 0)


def test_another_number_of_entries_is_an_error() -> None:
    entry = arrays((0, "laser: rate", 0, ""), (0, "laser: motor", 0, ""), (0, "imu", 0, ""))
    assert judged(Config(names=("^laser",), count=2), entry, 1)[0] is True
    found = judged(Config(names=("^laser",), count=3), entry, 1)
    assert found == (False, 2, "2 entries, 3 expected")
    assert list(Config(names=("a",), count=0).check())


def test_an_entry_may_be_absent() -> None:
    entry = arrays((0, "laser", 0, "fine"), (4, "imu", 0, "fine"))
    config = Config(names=("^laser", "^battery"), absent_ok=True)
    assert judged(config, entry, 1) == (True, 0, "laser: fine")
    assert judged(config, entry, 8) == (True, 0, "none is there")


def test_publishers_send_arrays_of_their_own() -> None:
    entry = arrays((0, "imu", 0, ""), (0.5, "laser", 1, "dirty"), (1, "imu", 0, ""))
    assert judged(BOTH, entry, 1) == (False, 1, "laser: dirty")


def test_an_entry_that_no_longer_comes_is_stale() -> None:
    rows: list[Row] = [(k, "imu", 0, "fine") for k in range(20)]
    entry = arrays((0, "laser", 0, "fine"), *rows)
    assert judged(BOTH, entry, 4.9)[:2] == (True, 0)
    assert judged(BOTH, entry, 5.0) == (False, 3, "no entry for 5 s")
    assert judged(BOTH, entry, 19) == (False, 3, "no entry for 5 s")


def test_before_there_was_time_for_all_of_them_nothing_is_known() -> None:
    entry = arrays((0, "imu", 0, "fine"), (6, "laser", 0, "fine"))
    assert judged(BOTH, entry, 1)[0] == UNKNOWN


@pytest.mark.parametrize(
    ("level", "expected"),
    [("OK", 0), ("warn", 1), ("Error", 2), ("STALE", 3), (3, 3), (7, 2), (None, 2), ("what", 2)],
)
def test_levels_may_be_spelt_out_and_nonsense_is_an_error(level: Any, expected: int) -> None:
    found = judged(Config(names=("imu",)), arrays((0, "imu", level, None)), 0)
    assert found == (expected == 0, expected, "imu: ")


def test_explanation() -> None:
    assert mode.explain(BOTH, {"ok": False, "level": 2, "message": "imu: dead"}) == "imu: dead"
    assert mode.explain(BOTH, {"ok": None}) == ""


@pytest.mark.parametrize(
    "config", [Config(names=()), Config(names=("(",)), Config(names=("a",), max_age=0)]
)
def test_what_finds_no_entry_is_refused(config: Config) -> None:
    assert list(config.check())


def test_a_column_may_be_younger_than_the_table() -> None:
    entry = arrays((0, "imu", 0, "old"), (1, "laser", 0, "fine"), (2, "imu", 0, "fine"))
    young = one_input(times_s=[1, 2], parts={"message": ["fine", "good"]})
    entry.parts = {**entry.parts, "message": young.parts["message"]}
    assert judged(Config(names=("imu",)), entry, 2)[2] == "imu: good"
    assert judged(Config(names=("laser",)), entry, 2)[2] == "laser: fine"
    entry.parts = {"name": entry.parts["name"], "level": entry.parts["level"]}
    assert judged(Config(names=("imu",)), entry, 2) == (True, 0, "imu: ")
