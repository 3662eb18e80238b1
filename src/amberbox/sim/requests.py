"""Requests to the simulated robot: which there are, their parameters and limits, and the check.

A request is a JSON object such as ``{"do": "linear", "distance_m": 1.0}``. Whatever comes is
checked here before the robot sees it.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import msgspec

from amberbox.core.errors import UsageError, did_you_mean
from amberbox.sim.navigation import MAX_SPEED, MAX_YAW_RATE
from amberbox.sim.topics import NODES
from amberbox.sim.world import CART_PLACES, PLACES

MAX_REQUEST_BYTES = 4096
_SHOWN = 40  # characters of a wrong value that an answer repeats


@dataclass(frozen=True, slots=True)
class NumberParameter:
    """A finite number with its limits; without a default it must be given."""

    unit: str
    low: float
    high: float
    default: float | None = None
    is_required: bool = False

    def problem(self, value: object) -> str:
        """Return what is wrong with a value, or nothing."""
        if isinstance(value, bool) or not isinstance(value, int | float):
            return f"must be a number, not {_shown(value)}"
        if not self.low <= value <= self.high:
            return f"must lie from {self.low:g} to {self.high:g} {self.unit}, not {_shown(value)}"
        return ""


@dataclass(frozen=True, slots=True)
class NameParameter:
    """One of some names; any short text where there are none."""

    names: tuple[str, ...] = ()
    is_required: bool = False
    default: str | None = None

    def problem(self, value: object) -> str:
        """Return what is wrong with a value, or nothing."""
        if not isinstance(value, str) or len(value) > _SHOWN:
            return f"must be a name of at most {_SHOWN} characters"
        if self.names and value not in self.names:
            return f"is none of {', '.join(self.names)}{did_you_mean(value, self.names)}"
        return ""


Parameter = NumberParameter | NameParameter

REQUESTS: Mapping[str, Mapping[str, Parameter]] = {
    "linear": {
        "distance_m": NumberParameter("m", -20.0, 20.0, is_required=True),
        "speed_m_s": NumberParameter("m/s", 0.05, MAX_SPEED, 0.2),
    },
    "rotate": {
        "angle_rad": NumberParameter("rad", -4 * math.pi, 4 * math.pi),
        "angle_deg": NumberParameter("deg", -720.0, 720.0),
        "speed_rad_s": NumberParameter("rad/s", 0.1, MAX_YAW_RATE, 0.4),
    },
    "go_to": {"area": NameParameter(tuple(PLACES), is_required=True)},
    "dock": {},
    "undock": {},
    "load": {"area": NameParameter(CART_PLACES)},
    "unload": {"area": NameParameter(CART_PLACES)},
    "stop": {},
    "resume": {},
    "restart": {"process": NameParameter(NODES, is_required=True)},
    "status": {"id": NameParameter()},
}
MOTIONS = ("linear", "rotate", "go_to", "dock", "undock", "load", "unload")


@dataclass(frozen=True, slots=True)
class RobotRequest:
    """A request that was checked; angles are in radians."""

    do: str
    parameters: Mapping[str, float | str]
    wait: bool = True

    def number(self, name: str) -> float:
        """Return a parameter that is a number."""
        return float(self.parameters[name])

    def text(self, name: str) -> str:
        """Return a parameter that is a name; empty when it was not given."""
        return str(self.parameters.get(name, ""))


def decode_request(data: bytes) -> RobotRequest:
    """Read the JSON text of a request.

    Raises UsageError naming all problems if it is too long, no JSON or no request.
    """
    if len(data) > MAX_REQUEST_BYTES:
        raise UsageError(f"the request has {len(data)} bytes", f"at most {MAX_REQUEST_BYTES}")
    try:
        value = msgspec.json.decode(data)
    except (msgspec.DecodeError, RecursionError) as error:
        what = "nested too deeply" if isinstance(error, RecursionError) else str(error)
        raise UsageError(f"the request is no JSON: {what}", '{"do": "status"}') from error
    return check_request(value)


def check_request(value: object) -> RobotRequest:
    """Check a decoded request; raises UsageError naming all problems at once."""
    hint = f"requests are {', '.join(REQUESTS)}"
    if not isinstance(value, dict):
        raise UsageError(f"a request is an object, not {_shown(value)}", '{"do": "status"}')
    do = value.get("do")
    if not isinstance(do, str) or do not in REQUESTS:
        near = did_you_mean(do, REQUESTS) if isinstance(do, str) and len(do) <= _SHOWN else ""
        raise UsageError(f"do: there is no {_shown(do)}{near}", hint)
    problems = list(_problems(do, value))
    if problems:
        known = ", ".join(["do", "wait", *REQUESTS[do]])
        raise UsageError(f"{do}: {'; '.join(problems)}", f"keys of {do} are {known}")
    wanted = REQUESTS[do]
    defaults = {key: p.default for key, p in wanted.items() if p.default is not None}
    parameters = defaults | {key: value[key] for key in wanted if key in value}
    if "angle_deg" in parameters:
        parameters["angle_rad"] = math.radians(parameters.pop("angle_deg"))
    return RobotRequest(do, parameters, value.get("wait", True))


def _problems(do: str, value: Mapping[str, Any]) -> Iterator[str]:
    wanted = REQUESTS[do]
    for key in value:
        if key not in wanted and key not in ("do", "wait"):
            yield f"unknown key {_shown(key)}{did_you_mean(key[:_SHOWN], [*wanted, 'wait'])}"
    if not isinstance(value.get("wait", True), bool):
        yield "wait must be true or false"
    for key, parameter in wanted.items():
        if key not in value:
            if parameter.is_required:
                yield f"{key} is missing"
        elif problem := parameter.problem(value[key]):
            yield f"{key} {problem}"
    if do == "rotate" and ("angle_rad" in value) == ("angle_deg" in value):
        yield "give angle_rad or angle_deg"


def _shown(value: object) -> str:
    text = repr(value) if isinstance(value, str | int | float | None) else type(value).__name__
    return text if len(text) <= _SHOWN else f"{text[:_SHOWN]}..."
