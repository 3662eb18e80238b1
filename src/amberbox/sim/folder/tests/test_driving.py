"""What the simulated robot does when it is told to; its way has to be free."""

import math

import pytest


def place(variable):
    """Return where the robot is by its odometry, in metres."""
    return [variable(f"sim_odom.pose/position/{axis}").value for axis in "xy"]


@pytest.mark.risk("moves")
@pytest.mark.timeout_s(60)
def test_drives_half_a_metre(act, wait_for, variable, recording, measure):
    """It drives as far as it was told, by its odometry, and stands still then."""
    act("stop")
    wait_for("abs(sim_odom.twist_linear_x) < 0.02 for 0.5s", within_s=10)
    before = place(variable)
    with recording("half a metre"):
        act("drive_linear", distance_m=0.5, speed_m_s=0.25)
        wait_for("abs(sim_odom.twist_linear_x) < 0.02 for 0.5s", within_s=10)
    driven_m = measure("distance", math.dist(before, place(variable)), "m")
    assert driven_m == pytest.approx(0.5, abs=0.05)
