"""Evaluation event by event: what counts as found, false alarms, baselines, labels."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from amberbox.core.clock import NS
from amberbox.core.contracts import ScoreReason
from amberbox.core.errors import ConfigurationError
from amberbox.core.timestamps import parse_time
from amberbox.detection.alarms import DetectorAlarm
from amberbox.detection.evaluation import (
    ALL,
    ALWAYS,
    RANDOM,
    Evaluation,
    EvaluationRow,
    evaluate,
)
from amberbox.detection.labels import FaultLabel, read_labels
from amberbox.detection.record_detection import Detected, DetectorScore

SOURCES = {"imu": "ros", "wheel": "can"}


def scores(seconds: int, detector: str = "guard") -> list[Detected]:
    return [DetectorScore(detector, (s + 1) * NS, 0.5, "imu", 0) for s in range(seconds)]


def alarm(from_s: float, to_s: float | None, item: str = "imu", series: str = "") -> list[Detected]:
    """Return an alarm that begins and, with ``to_s``, ends."""
    at_ns = round(from_s * NS)
    reason = ScoreReason("range", item, "a", "")
    begun = DetectorAlarm(
        "guard", series or item, at_ns, at_ns, 2.0, 1.0, 0.01, "fleet", reason
    )  # fmt: skip
    return [begun] if to_s is None else [begun, begun.ended(round(to_s * NS))]


def label(from_s: float, to_s: float, item: str = "", source: str = "") -> FaultLabel:
    return FaultLabel(round(from_s * NS), round(to_s * NS), item, source)


def judged(found: Sequence[Detected], labels: Sequence[FaultLabel]) -> Evaluation:
    return evaluate(found, labels, SOURCES)


def row(found: Evaluation, name: str = "guard") -> EvaluationRow:
    return next(one for one in found.rows if one.detector == name)


def test_a_fault_counts_if_an_episode_starts_in_its_window() -> None:
    faults = [label(100, 110, "imu"), label(200, 210, "imu.a"), label(300, 310, "wheel")]
    found = [*scores(3600), *alarm(103, 108), *alarm(214, 216), *alarm(299.5, 305)]
    all_found = row(judged(found, faults))
    assert (all_found.recall, all_found.precision, all_found.f1) == (1.0, 1.0, 1.0)
    assert all_found.false_alarms_per_hour == 0
    assert all_found.delay_median_s == 3 and all_found.delay_max_s == 14
    assert all_found.isolated == pytest.approx(2 / 3)
    late = row(judged([*scores(3600), *alarm(117, 118), *alarm(290, 400)], faults))
    assert late.recall == 0  # one after its tail, the other was on before
    assert late.precision == 0


def test_false_alarms_are_each_ten_seconds_begun_in_nominal_time() -> None:
    faults = [label(100, 110, source="ros")]
    found = [*scores(1000), *alarm(102, 104), *alarm(500, 535), *alarm(510, 512, series="other")]
    one = row(judged(found, faults))
    assert one.false_alarms == 4
    assert one.precision == pytest.approx(1 / 5)
    assert one.isolated == 1
    nominal_s = 1000 - 17
    assert one.false_alarms_per_hour == pytest.approx(4 * 3600 / nominal_s)
    lasting = row(judged([*scores(1000), *alarm(990, None)], faults))
    assert lasting.false_alarms == 1  # to the end of the record
    flapping = [*scores(1000), *alarm(96, 98.5), *alarm(99.5, 120)]
    assert row(judged(flapping, faults)).recall == 0  # merged over a short gap: on before


def test_rows_beside_show_what_chance_gives() -> None:
    faults = [label(at, at + 10) for at in range(100, 1000, 100)]
    many = [a for at in range(0, 1000, 12) for a in alarm(at, at + 1, series=f"{at}")]
    found = judged([*scores(1000), *many], faults)
    chance, mine = row(found, RANDOM), row(found)
    assert chance.false_alarms_per_hour == mine.false_alarms_per_hour
    assert chance.recall > 0.5  # so many alarms hit something
    always = row(found, ALWAYS)
    assert always.recall == 0 and always.false_alarms > 50
    quiet = judged(scores(1000), faults)
    assert row(quiet, RANDOM).recall == 0 and row(quiet).precision is None
    both = judged([*scores(1000), *scores(1000, "residual"), *alarm(102, 104)], faults)
    assert [one.detector for one in both.rows] == ["guard", "residual", ALL, RANDOM, ALWAYS]
    assert both.outside == 0 and judged(scores(450), faults).outside == 5
    far = FaultLabel(-(2**63) + 1, 2**63 - 1)
    assert row(judged(scores(100), [far])).false_alarms_per_hour is None  # no nominal time
    nothing = judged([], faults)
    assert nothing.nominal_h == 0 and row(nothing, ALWAYS).false_alarms_per_hour is None


def test_labels_are_read_from_yaml_and_csv(tmp_path: Path) -> None:
    def time_ns(text: str) -> int:
        return parse_time(text, lambda: 0, lambda: 0)

    yaml, csv = tmp_path / "a.yaml", tmp_path / "a.csv"
    yaml.write_text("- {from: 2026-01-05T08:01:00Z, to: 2026-01-05T08:01:15Z, item: imu.a}\n")
    csv.write_text("from,to,item,name\n2026-01-05 08:01,1767600075,imu.a,\n\n")
    assert read_labels(yaml, time_ns) == read_labels(csv, time_ns)
    yaml.write_text("- {from: x, itm: imu}\n- 3\n- {from: 20, to: 10}\n- {from: [1], to: 10}\n")
    with pytest.raises(ConfigurationError) as error:
        read_labels(yaml, time_ns)
    texts = [str(problem) for problem in error.value.problems]
    for text in ("a.yaml:1: from: not a time", "did you mean 'item'", "a.yaml:2: label: expected",
                 "a.yaml:3: to: the fault ends before", "a.yaml:4: from: expected"):  # fmt: skip
        assert any(text in one for one in texts), text
    for content in ("", "{}", "from,to\n"):
        yaml.write_text(content)
        with pytest.raises(ConfigurationError):
            read_labels(yaml, time_ns)


@given(st.text(max_size=300))
def test_any_table_is_read_or_refused(tmp_path_factory: pytest.TempPathFactory, text: str) -> None:
    path = tmp_path_factory.getbasetemp() / "any.csv"
    path.write_text(text, errors="replace")
    try:
        read_labels(path, lambda word: parse_time(word, lambda: 0, lambda: 0))
    except ConfigurationError as error:
        assert error.problems
