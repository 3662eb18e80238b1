"""The helpers that measure and the page they write."""

from __future__ import annotations

import time

import pytest

from benchmarks.common import Row, cpu_s, percentile, wall_s
from benchmarks.run import Result, benchmarks, machine, number, page


def test_cpu_time_is_work_and_not_waiting() -> None:
    begin_s = time.process_time()
    waited = cpu_s(lambda: time.sleep(0.2), repeats=1)
    assert waited <= time.process_time() - begin_s  # threads of other tests work meanwhile
    assert wall_s(lambda: time.sleep(0.2), 1) >= 0.2


@pytest.mark.parametrize(("percent", "value"), [(0, 1), (50, 2), (51, 3), (95, 4), (100, 4)])
def test_percentile(percent: float, value: float) -> None:
    assert percentile([4.0, 1.0, 3.0, 2.0], percent) == value


@pytest.mark.parametrize(
    ("value", "text"),
    [(0.0, "0"), (0.01234, "0.0123"), (1.5, "1.50"), (99.95, "100.0"), (1234567.0, "1,230,000")],
)
def test_numbers_have_three_digits(value: float, text: str) -> None:
    assert number(value) == text


def test_the_page_holds_every_row_and_no_name_of_the_machine() -> None:
    rows = [Row("journal", 950_000, "messages/s", "rosbags", 3.2, "write_s 0.1"), Row("x", 1, "s")]
    text = page([Result("record", "What it costs.", rows, "2026-01-01", machine())])
    assert "Measured on 2026-01-01: processor" in text
    assert "| journal | 950,000 | messages/s | rosbags | 3.2 | write_s 0.1 |" in text
    assert "| x | 1.00 | s |  |  |  |" in text
    assert "hostname" not in machine() and "numpy" in machine()


def test_a_file_without_measure_is_no_benchmark() -> None:
    assert not {"__init__", "run", "common"} & set(benchmarks())
