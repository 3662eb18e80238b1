"""What the sensors of the simulated robot must show while it runs; these tests only read."""

import pytest

SIDES = [
    pytest.param(side, marks=pytest.mark.tests(f"laser_{side}#silent"))
    for side in ("front", "rear")
]


@pytest.mark.parametrize("side", SIDES)
def test_laser_publishes_at_its_rate(side, wait_for, variable, measure):
    """Each laser sends 10 scans a second."""
    wait_for(f"count(sim_scan_{side}.scan_time over 2s) >= 15", within_s=10)
    measure("scan_time", variable(f"sim_scan_{side}.scan_time").value, "s")


@pytest.mark.tests("battery#empty", "battery#cell_weak")
def test_battery_is_plausible(variable, measure):
    """Seven cells of 3 to 4.25 V, more than 10 % charge."""
    voltage = measure("voltage", variable("sim_battery.voltage").value, "V")
    charge = measure("charge", variable("sim_battery.percentage").value, "%")
    assert 7 * 3.0 < voltage < 7 * 4.25
    assert charge > 10


@pytest.mark.tests("safety#e_stop_pressed")
def test_no_emergency_stop_is_pressed(variable):
    """The drives can be enabled."""
    safety = variable("sim_safety.e_stop_pressed").newest
    assert safety.age_s < 5, "the safety controller is silent"
    assert not safety.value


def test_lasers_are_monitored(wait_for):
    """The watcher says that both lasers are well, within the time that a busy robot may take."""
    for component in ("laser_front", "laser_rear"):
        wait_for(f'status({component}) == "ok"', within_s=20)


def share_covered(scans):
    """Return the share of beams that end within 0.3 m of the laser in every one of some scans."""
    near = [[0 < beam < 0.3 for beam in scan] for scan in scans]
    return sum(map(all, zip(*near, strict=True))) / len(near[0])


@pytest.mark.parametrize("side", ["front", "rear"])
def test_nothing_covers_laser(side, variable, measure):
    """No sector of a laser ends at its own window; a dirty window loses beams here and there."""
    scans = [row.value for row in variable(f"sim_scan_{side}.ranges").last(3)]
    assert len(scans) >= 10, "there are too few scans of the last 3 s"
    assert measure("covered", share_covered(scans)) < 0.02
