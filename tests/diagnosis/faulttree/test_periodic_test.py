"""The unavailability of tested components, against small steps of its Markov process."""

from __future__ import annotations

import math
from pathlib import Path

import pytest

from amberbox.core.errors import ConfigurationError
from amberbox.diagnosis.faulttree.open_psa import read_mef, write_mef
from amberbox.diagnosis.faulttree.periodic_test import periodic_test

RATE, REPAIR, BETWEEN, FIRST = 1e-3, 0.02, 500.0, 200.0


@pytest.mark.parametrize("time", [0.0, 150.0, 200.0, 260.0, 700.0, 701.0, 3456.0])
def test_a_repair_at_once_leaves_the_time_since_the_last_test(time: float) -> None:
    since = time if time <= FIRST else math.fmod(time - FIRST, BETWEEN) or BETWEEN
    found = periodic_test(RATE, BETWEEN, FIRST, time)
    assert found == pytest.approx(1 - math.exp(-RATE * since), rel=1e-12)


def in_small_steps(arguments: tuple[float, ...], steps_per_unit: int = 64) -> float:
    """Return the unavailability by the process itself, step by step."""
    rate, in_test, repair, between, first, starts, lasts, usable, detects, bad, time = arguments
    available, failed, repaired, tested = 1.0, 0.0, 0.0, 0.0
    testing = failed_in_test = 0.0
    step = 1.0 / steps_per_unit
    for number in range(round(time * steps_per_unit)):
        since = number * step - first
        place = math.fmod(since, between) if since >= 0 else math.inf
        if since >= 0 and place < step / 2:
            tested, failed_in_test = available * (1 - starts), failed + available * starts
            available = failed = 0.0
            testing = 1.0
        if testing and place >= lasts - step / 2:
            available += tested * (1 - bad)
            failed += tested * bad + failed_in_test * (1 - detects)
            repaired += failed_in_test * detects
            tested = failed_in_test = testing = 0.0
        fails, done = available * rate * step, repaired * repair * step
        available += done * (1 - bad) - fails
        failed += fails + done * bad
        repaired -= done
        tested, failed_in_test = (
            tested * (1 - in_test * step), failed_in_test + tested * in_test * step
        )  # fmt: skip
    return 1 - available - (tested if usable else 0.0)


@pytest.mark.parametrize("time", [150.0, 210.0, 240.0, 650.0, 1999.0])
@pytest.mark.parametrize("usable", [0.0, 1.0])
def test_all_parameters_are_those_of_the_process(time: float, usable: float) -> None:
    given = (RATE, 3e-3, REPAIR, BETWEEN, FIRST, 0.05, 40.0, usable, 0.9, 0.02, time)
    assert periodic_test(*given) == pytest.approx(in_small_steps(given), rel=2e-3)


def test_fewer_parameters_are_special_cases() -> None:
    for time in (150.0, 450.0, 700.0, 5123.0):
        five = periodic_test(RATE, REPAIR, BETWEEN, FIRST, time)
        eleven = (RATE, 0.0, REPAIR, BETWEEN, FIRST, 0.0, 0.0, 1.0, 1.0, 0.0, time)
        assert periodic_test(*eleven) == pytest.approx(five, rel=1e-12)
        fast = periodic_test(RATE, 1e9, BETWEEN, FIRST, time)
        four = periodic_test(RATE, BETWEEN, FIRST, time)
        assert fast == pytest.approx(four, rel=1e-6)
    same = periodic_test(RATE, RATE, BETWEEN, FIRST, 900.0)
    assert same == pytest.approx(
        periodic_test(RATE, RATE * 1.0001, BETWEEN, FIRST, 900.0), rel=1e-3
    )


def test_very_many_tests_take_no_longer() -> None:
    far = periodic_test(1e-6, 0.1, 1e-3, 0.0, 1e9)
    assert far == pytest.approx(periodic_test(1e-6, 0.1, 1e-3, 0.0, 1e6), rel=1e-2)


def _file(tmp_path: Path, expression: str) -> Path:
    path = tmp_path / "tested.xml"
    path.write_text(f"""<opsa-mef>
<define-fault-tree name="t"><define-gate name="top"><or><event name="valve"/></or></define-gate>
</define-fault-tree>
<model-data><define-basic-event name="valve">
{expression}
</define-basic-event></model-data></opsa-mef>""")
    return path


def _floats(*values: float) -> str:
    return "".join(f'<float value="{value!r}"/>' for value in values)


def test_it_is_read_and_written(tmp_path: Path) -> None:
    given = (RATE, REPAIR, BETWEEN, FIRST)
    inside = f"<periodic-test>{_floats(*given)}<system-mission-time/></periodic-test>"
    tree = read_mef(_file(tmp_path, inside), mission_time_h=1234.0)
    assert tree.events["valve"].probability == periodic_test(*given, 1234.0)
    path = tmp_path / "again.xml"
    path.write_text(write_mef(tree))
    assert read_mef(path, mission_time_h=1234.0).events == tree.events


@pytest.mark.parametrize(
    ("values", "what"),
    [
        ((1.0, 2.0, 3.0), "'periodic-test' needs 4, 5 or 11 inputs, not 3"),
        ((1.0, 0.0, 3.0, 4.0), "the time between tests 0 is not above 0"),
        ((-1.0, 2.0, 3.0, 4.0), "the rate -1 of a periodic test is not 0 or more"),
        ((1, 1, 1, 5, 1, 0.1, 6, 1, 1, 0, 9), "lasts longer than the time between tests"),
        ((1, 1, 1, 5, 1, 1.1, 2, 1, 1, 0, 9), "1.1 in a periodic test is not between 0 and 1"),
    ],
)
def test_values_out_of_range_are_refused(
    tmp_path: Path, values: tuple[float, ...], what: str
) -> None:
    path = _file(tmp_path, f"<periodic-test>{_floats(*values)}</periodic-test>")
    with pytest.raises(ConfigurationError, match="valve: has no value") as error:
        read_mef(path)
    assert what in str(error.value)
