"""What can be broken in a robot of the demonstration: faults of the simulator that show quickly."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Offer:
    """A fault that is offered: the component that shows it first, and what is to blame."""

    component: str
    failure_mode: str


OFFERS: Mapping[str, Offer] = {
    "wheel_rear_right_power_stage_trips": Offer(
        "wheel_rear_right", "wheel_rear_right#power_stage_trips"
    ),
    "wheel_front_left_bus_disconnected": Offer("bus", "wheel_front_left#bus_disconnected"),
    "laser_rear_motor_slow": Offer("laser_rear", "laser_rear#motor_slow"),
    "laser_front_driver_crash": Offer("laser_front", "laser_front#driver_crash"),
    "imu_stuck": Offer("imu", "imu#stuck"),
    "localisation_crash": Offer("localisation", "localisation#crash"),
    "bumper_switch_closed": Offer("safety", "safety#bumper_switch_closed"),
}
"""By the fault's name in the simulator's catalogue."""
