"""Consecutive bad samples, a single one, and one that lasts because a filter drops repetitions."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from amberbox.core.mode import FALSE, TRUE, UNKNOWN
from amberbox.core.samples import Samples
from amberbox.monitoring.modes import working_counter as mode
from amberbox.monitoring.modes.working_counter import Config
from amberbox.testing.modes import assert_mode_contract, at_s, one_input

NOMINAL = Config(expected=12)


def verdicts(config: Config, counts: list[int], at: Any) -> Any:
    entry = one_input(times_s=[k / 10 for k in range(len(counts))], values=counts)
    return np.asarray(mode.evaluate(config, [entry], at)["complete"]).tolist()


def test_contract() -> None:
    configs = [Config(expected=3), Config(expected=0x32, samples=4, lasting=1.0)]
    assert_mode_contract(mode, "working_counter", configs=configs, text=True)


def test_one_bad_sample_is_forgiven_and_two_in_a_row_are_not() -> None:
    counts = [12, 6, 12, 6, 6, 6, 12, 12]
    at = at_s(*(k / 10 for k in range(8)))
    assert verdicts(NOMINAL, counts, at) == [1, 1, 1, 1, 0, 0, 1, 1]
    assert verdicts(Config(expected=12, samples=1), counts, at) == [1, 0, 1, 0, 0, 0, 1, 1]
    assert verdicts(Config(expected=12, samples=3), counts, at) == [1, 1, 1, 1, 1, 0, 1, 1]


def test_more_slaves_than_there_should_be_are_no_better() -> None:
    assert verdicts(NOMINAL, [15, 15], at_s(0.1)) == FALSE


def test_a_bad_sample_that_stands_counts_where_the_filter_keeps_only_changes() -> None:
    assert verdicts(NOMINAL, [12, 6], at_s(1.0, 2.05, 2.1, 9)) == [TRUE, TRUE, FALSE, FALSE]
    assert verdicts(NOMINAL, [12, 6, 12], at_s(2.1, 9)) == [TRUE, TRUE]


def test_unknown_counters() -> None:
    entry = one_input(times_s=[1, 2], values=[None, 12])
    found = mode.evaluate(NOMINAL, [entry], at_s(0, 1, 2))
    assert found["complete"].tolist() == [UNKNOWN, UNKNOWN, TRUE]


def test_explanation() -> None:
    bad = {"complete": False, "counter": 6}
    assert mode.explain(NOMINAL, bad) == "the working counter is 6, expected 12"
    assert mode.explain(NOMINAL, {"complete": None, "counter": None}) == ""


@pytest.mark.parametrize(
    "config", [Config(expected=0), Config(expected=1, samples=0), Config(expected=1, lasting=0)]
)
def test_what_no_counter_can_be_is_refused(config: Config) -> None:
    assert list(config.check())


@pytest.mark.needs_data
def test_the_one_low_counter_among_182_real_samples_is_forgiven(
    shared_data: Path, tmp_path: Path
) -> None:
    import amberbox
    from amberbox.blackbox.query.importing import import_recordings

    import_recordings([shared_data / "ropod/bb_test_data"], tmp_path, segments=False)
    with amberbox.open(tmp_path) as record:
        table = record.query("ros_sw_ethercat_parser_data", ["working_count"])
        times = np.asarray(table["timestamp"]).astype(np.int64)
        counts = np.asarray(table["working_count"]).astype(np.int64)
    entry = one_input()
    entry.samples = Samples()
    entry.samples.extend(times, counts)
    assert len(counts) == 182
    assert np.count_nonzero(counts != 12) == 1
    assert np.all(mode.evaluate(NOMINAL, [entry], times)["complete"] == TRUE)
    strict = mode.evaluate(Config(expected=12, samples=1), [entry], times)["complete"]
    assert np.count_nonzero(strict == FALSE) == 1


def test_a_dead_slave_is_found_within_two_cycles() -> None:
    counts = [12] * 50 + [9] * 20
    entry = one_input(times_s=[k / 7 for k in range(70)], values=counts)
    found = mode.evaluate(NOMINAL, [entry], entry.samples.times_ns)["complete"]
    assert np.flatnonzero(found == FALSE).tolist() == list(range(51, 70))
