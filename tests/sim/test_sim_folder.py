"""The folder of the simulated robot: map, areas and actions are those of its world."""

from __future__ import annotations

import re
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from amberbox import sim
from amberbox.agent.recovery_actions import command_lines, recovery_actions
from amberbox.blackbox.robot_folder.folder import load_folder
from amberbox.cli.main import main
from amberbox.consult.folder_knowledge import load_knowledge
from amberbox.core.errors import UsageError
from amberbox.experiments.action import read_actions
from amberbox.sim.noise import Noise
from amberbox.sim.requests import MOTIONS, REQUESTS, check_request
from amberbox.sim.world import CART_PLACES, PLACES, HospitalWorld
from tests.sim.commanded import begin, end, standing
from tests.sim.monitored import plan_of

FOLDER = Path(sim.__file__).parent / "folder"
EXAMPLES: dict[str, dict[str, Any]] = {
    "drive_linear": {"distance_m": 0.4, "speed_m_s": 0.2},
    "rotate": {"angle_rad": 0.5, "speed_rad_s": 0.4},
    "go_to_area": {"area": "ward_a"},
    "dock": {},
    "undock": {},
    "load": {"area": "ward_a"},
    "unload": {"area": "ward_a"},
    "stop": {},
    "restart_process": {"process": "laser_front"},
    "resume_tasks": {},
}
CALM = ("stop", "restart_process", "resume_tasks")


def read(name: str) -> Any:
    return yaml.safe_load((FOLDER / name).read_text(encoding="utf-8"))


def test_the_map_is_the_building_that_lasers_see() -> None:
    lines = read("map.yaml")
    segments = [[*a, *b] for chain in lines["walls"] for a, b in pairwise(chain)]
    for x0, y0, x1, y1 in lines["furniture"]:
        corners = [(x0, y0), (x1, y0), (x1, y1), (x0, y1), (x0, y0)]
        segments += [[*a, *b] for a, b in pairwise(corners)]
    assert np.array_equal(np.array(segments, np.float64), HospitalWorld(Noise(1, "")).building)


def test_the_areas_are_the_places_of_the_world() -> None:
    areas = read("areas.yaml")
    assert {name for name, area in areas.items() if "spot" in area} == set(PLACES)
    assert {name for name, area in areas.items() if area.get("carts")} == set(CART_PLACES)
    for name, area in areas.items():
        (x0, y0), _, (x1, y1), _ = area["polygon"]
        assert x0 < x1 and y0 < y1 and area["description"]
        if name in PLACES:
            assert tuple(area["spot"]) == PLACES[name].spot
            assert x0 < area["spot"][0] < x1 and y0 < area["spot"][1] < y1


def filled(template: dict[str, Any], values: dict[str, Any]) -> dict[str, Any]:
    """Return a request with the values of an action's parameters."""
    names = {key: re.fullmatch(r"\{(\w+)\}", str(value)) for key, value in template.items()}
    return {k: values[m[1]] if (m := names[k]) else value for k, value in template.items()}


def test_every_motion_is_an_action_that_can_be_stopped() -> None:
    actions = read("actions/sim.yaml")
    assert set(actions) == set(EXAMPLES)
    done = {action["request"]["do"] for action in actions.values()}
    assert done == {*MOTIONS, "stop", "restart", "resume"}
    for name, action in actions.items():
        risk, stop = ("state", None) if name in CALM else ("moves", {"do": "stop"})
        assert (action["kind"], action["risk"]) == ("zmq_request", risk), name
        assert action.get("safe_stop") == stop and action["description"]
        assert action["expect"] == {"ok": True}
        assert set(action.get("parameters", {})) == set(EXAMPLES[name])


@pytest.mark.parametrize("name", EXAMPLES)
def test_what_an_action_sends_is_a_request(name: str) -> None:
    action = read("actions/sim.yaml")[name]
    request = filled(action["request"], EXAMPLES[name])
    assert check_request(request).do == action["request"]["do"]
    for key, limits in action.get("parameters", {}).items():
        wanted = REQUESTS[request["do"]][key]
        if "choices" in limits:
            assert tuple(limits["choices"]) == getattr(wanted, "names", None)
            continue
        for size in (limits["min"], limits["max"], limits.get("default", limits["min"])):
            check_request({**request, key: size})
        with pytest.raises(UsageError, match=key):
            check_request({**request, key: 1e6})


@pytest.mark.parametrize("name", ["drive_linear", "rotate"])
def test_an_action_moves_the_robot(name: str) -> None:
    robot = standing()
    request = filled(read("actions/sim.yaml")[name]["request"], EXAMPLES[name])
    assert end(robot, begin(robot, request.pop("do"), **request))["state"] == "done"


def test_a_new_folder_has_them(tmp_path: Path) -> None:
    assert main(["new", str(tmp_path / "robot"), "--from", "sim"]) == 0
    for name in ("map.yaml", "areas.yaml", "actions/sim.yaml"):
        assert (tmp_path / "robot" / name).read_text() == (FOLDER / name).read_text()
    assert main(["check", str(tmp_path / "robot")]) == 0


def test_what_the_failure_modes_name_for_recovery_can_be_run(tmp_path: Path) -> None:
    plan, _ = plan_of(tmp_path / "robot")
    knowledge, _ = load_knowledge(load_folder(tmp_path / "robot"), plan)
    assert knowledge is not None
    actions, _ = read_actions(tmp_path / "robot")
    found = recovery_actions(plan, knowledge.fmea, actions)
    assert [one for one in found if not one.action] == []
    assert {"laser_front#driver_crash", "localisation#hang"} <= {one.cause for one in found}
    lines = list(command_lines(found, ["laser_rear#driver_crash"], "a robot"))
    assert lines == ["amberbox action run 'a robot' restart_process process=laser_rear"]
