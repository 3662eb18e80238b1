"""Alarms of simulated robots, watched and diagnosed as on a robot: one for one fault, none else."""

from __future__ import annotations

from amberbox.core.clock import NS
from amberbox.sim.faults import catalogue
from amberbox.sim.robot import START_NS
from benchmarks.alarms import played, written
from benchmarks.missions import Mission, Planted

SEED = 3


def test_one_cut_power_supply_is_one_alarm_and_a_sound_robot_has_none() -> None:
    """The laser loses its power: laser, localisation and the log show it, the laser is to blame."""
    silent = catalogue()["laser_front_silent"]
    faulty = Mission(SEED, "transport", False, (Planted(silent, 1.0, 20.0),), 31.0)
    sound = Mission(SEED, "transport", False, (), 15.0)
    told = [list(written(faulty)), list(written(sound))]
    components = {line.data.split(b'"component":"')[1].split(b'"')[0] for line in told[0]
                  if line.channel == "amberbox/alarm"}  # fmt: skip
    assert components == {b"laser_front"}, "what the log says of it belongs to it from the first"
    outcome = played(told)
    (alarm,) = outcome.alarms
    assert (alarm.robot, alarm.origin, alarm.count) == ("robot_0", "laser_front", 1)
    assert alarm.cause.startswith("laser_front#silent (")
    assert START_NS + 20 * NS < alarm.opened_ns < START_NS + 23 * NS
    assert outcome.messages == 1
