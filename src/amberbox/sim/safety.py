"""The safety line: emergency stop button and bumpers; whatever trips it cuts the drives."""

from __future__ import annotations

from typing import Any

CONTACT_M = 0.2


class Safety:
    """Knobs (nominal value): ``stop_line`` (0) above 0.5 the line of the button is open,
    ``bumper`` (0) above 0.5 the front bumper's switch is closed."""

    def __init__(self) -> None:
        self.stop_line = 0.0
        self.bumper = 0.0
        self._touches_front = False
        self._touches_rear = False

    @property
    def is_stopped(self) -> bool:
        """Whether the drives are cut."""
        return self.stop_line > 0.5 or self.bumper > 0.5 or self.touches

    @property
    def touches(self) -> bool:
        """Whether the robot really stands against something."""
        return self._touches_front or self._touches_rear

    def feel(self, front_m: float, rear_m: float) -> None:
        """Take how near the nearest thing is to each end of the robot."""
        self._touches_front = front_m < CONTACT_M
        self._touches_rear = rear_m < CONTACT_M

    def fields(self) -> dict[str, Any]:
        """Return the body of a ``safety`` message."""
        return {
            "e_stop_pressed": self.stop_line > 0.5,
            "bumper_front": self._touches_front or self.bumper > 0.5,
            "bumper_rear": self._touches_rear,
            "drives_enabled": not self.is_stopped,
        }
