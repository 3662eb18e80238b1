from __future__ import annotations

import pytest

from amberbox.core.errors import UsageError
from amberbox.core.types import Symptom
from amberbox.diagnosis.covering.observations import Observation, collect_evidence


def symptom(name: str, source: str, *addresses: str, strength: float = 1.0) -> Symptom:
    """Make a present symptom measured from addresses during 10..20."""
    looked_at = tuple((address, 10, 20) for address in addresses)
    return Symptom(name, "present", strength=strength, source=source, evidence=looked_at)


def test_of_two_sources_with_one_measurement_the_stronger_counts() -> None:
    found = collect_evidence(
        [symptom("drift", "residual", "odom.x", strength=0.6), symptom("odd", "bank", "odom.x")]
    )
    assert found.observations == {"odd": Observation("present")}
    assert found.doubled == ("drift",)


def test_what_was_also_measured_elsewhere_counts() -> None:
    drift = symptom("drift", "residual", "odom.x", "imu.yaw", strength=0.6)
    found = collect_evidence([symptom("odd", "bank", "odom.x"), drift])
    assert set(found.observations) == {"odd", "drift"} and not found.doubled


def test_measurements_at_other_times_are_others() -> None:
    later = Symptom("drift", "present", source="residual", evidence=(("odom.x", 21, 30),))
    assert set(collect_evidence([symptom("odd", "bank", "odom.x"), later]).observations) == {
        "odd",
        "drift",
    }


def test_symptoms_of_one_source_all_count() -> None:
    both = [symptom("late", "monitor", "scan.ranges"), symptom("dark", "monitor", "scan.ranges")]
    assert set(collect_evidence(both).observations) == {"late", "dark"}


def test_present_wins_over_absent_of_equal_strength_and_unknown_is_nothing() -> None:
    found = collect_evidence(
        [
            Symptom("s", "absent", source="a"),
            Symptom("s", "present", source="b"),
            Symptom("t", "unknown"),
        ],
        [["a#x", "b#y"]],
    )
    assert found.observations == {"s": Observation("present")}
    assert found.conflicts == (frozenset({"a#x", "b#y"}),)


@pytest.mark.parametrize("strength", [0.0, -0.1, 1.1])
def test_a_strength_is_above_0_and_at_most_1(strength: float) -> None:
    with pytest.raises(UsageError, match="strength"):
        Observation("present", strength)
