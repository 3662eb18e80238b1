"""The FMEA of the simulated robot: complete, and consistent with its monitors."""

from __future__ import annotations

import itertools
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from amberbox.blackbox.robot_folder.folder import load_folder
from amberbox.cli.main import main
from amberbox.consult.folder_knowledge import fmea_references
from amberbox.core.clock import NS
from amberbox.core.expression import Expression
from amberbox.core.types import Batch, IntArray, Ragged
from amberbox.diagnosis.fmea.criticality import coverage
from amberbox.diagnosis.fmea.loader import load_fmea
from amberbox.diagnosis.fmea.model import Fmea, FmeaReferences, lost
from amberbox.monitoring.plan import MonitoringPlan
from amberbox.monitoring.plan_loader import load_plan
from amberbox.sim.faults import catalogue
from amberbox.sim.robot import START_NS
from tests.sim.monitored import FAULT_S, batches, failures, find, with_fault

OTHERWISE = {
    "load_loose": "base#load_loose",
    "e_stop_line_loose": "safety#e_stop_line_loose",
    "bumper_switch_closed": "safety#bumper_switch_closed",
}
"""Failure modes whose ids do not follow from the fault's; others are ``component_mode``."""

REACTIONS = {  # fault: seconds until what the FMEA expects of it has shown
    "wheel_front_right_phase_open": 5.0,
    "laser_rear_driver_crash": 8.0,
    "battery_current_sensor_bias": 6.0,
}


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("robot") / "r"
    assert main(["new", str(path)]) == 0
    return path


@pytest.fixture(scope="module")
def known(folder: Path) -> FmeaReferences:
    return fmea_references(load_folder(folder))


@pytest.fixture(scope="module")
def fmea(folder: Path, known: FmeaReferences) -> Fmea:
    loaded, problems = load_fmea(folder / "fmea.yaml", known)
    assert loaded is not None and problems == []
    return loaded


@pytest.fixture(scope="module")
def plan(folder: Path) -> MonitoringPlan:
    return load_plan(load_folder(folder))[0]


def mode_of(fault: str, fmea: Fmea) -> str:
    """Return the failure mode that a fault of the catalogue means."""
    if fault in OTHERWISE:
        return OTHERWISE[fault]
    return next(mode for mode in fmea.modes if mode.replace("#", "_") == fault)


def test_it_is_large_enough_to_be_an_example(fmea: Fmea) -> None:
    written = {(fmea.components[m.component].type, m.name) for m in fmea.modes.values()}
    assert len(written) >= 60 and len(fmea.modes) > len(written)
    assert all(m.description and m.classes and m.remedy for m in fmea.modes.values())
    assert all(mode.ranks.number for mode in fmea.modes.values())
    assert all(mode.cause for mode in fmea.modes.values())


def test_every_fault_of_the_catalogue_is_a_failure_mode(fmea: Fmea) -> None:
    modes = {fault: mode_of(fault, fmea) for fault in catalogue()}
    assert set(modes.values()) <= set(fmea.modes)
    assert len(set(modes.values())) == len(modes) == 101


def test_most_of_it_can_be_seen_and_told_apart(fmea: Fmea, known: FmeaReferences) -> None:
    found = coverage(fmea, sorted(known.watched))
    assert not found.unexplained
    assert len(found.unseen) <= 2 and found.distinct >= 0.9 * found.modes
    assert all(group.tests and not group.left for group in found.ambiguous)


def test_redundancy_gives_cut_sets_of_higher_order(fmea: Fmea) -> None:
    """Two failures in different components cost what neither costs alone."""
    down = [m for m in fmea.modes.values() if m.takes_down]
    one = {m.component: m.id for m in down}
    alone = {component: lost(fmea, [mode]) for component, mode in one.items()}
    redundant = {
        effect
        for (a, first), (b, second) in itertools.combinations(one.items(), 2)
        for effect in lost(fmea, [first, second]) - alone[a] - alone[b]
    }
    assert len(redundant & set(fmea.system_functions())) >= 6
    assert "know_floor" not in redundant  # that takes three
    three = [mode for component, mode in one.items() if component.endswith("_barometer")][:3]
    assert "know_floor" in lost(fmea, three)


CONDITIONS = {  # fault: the condition that shows it, beside the monitors
    "wheel_rear_left_bearing_drag": "wheel_rear_left.pulls_harder",
    "wheel_front_left_bus_disconnected": "wheel_front_left.frame_stays",
    "wheel_front_right_encoder_slips": "wheel_front_right.encoder_1_short",
    "wheel_rear_left_winding_hot": "wheel_rear_left.winding_1_heats",
}
LATEST_S = 20


@pytest.mark.parametrize("fault", CONDITIONS)
def test_conditions_show_what_they_are_for(fmea: Fmea, fault: str) -> None:
    record = {batch.item: batch for batch in batches(with_fault(fault, LATEST_S))}
    shown = {
        name
        for name, symptom in fmea.symptoms.items()
        if (condition := symptom.condition) is not None
        and not any("/" in address for address in condition.addresses())  # of monitors
        and _shows(condition, record)
    }
    links = {link.symptom for link in fmea.modes[mode_of(fault, fmea)].symptoms}
    assert CONDITIONS[fault] in shown
    assert shown <= links


def _shows(condition: Expression, record: Mapping[str, Batch]) -> bool:
    """Return whether a condition is true soon after a fault."""
    series = {name: _series(name, record) for name in condition.addresses()}
    at_ns = START_NS + np.arange(round(FAULT_S), round(FAULT_S) + LATEST_S) * NS
    return bool(np.ma.filled(condition.evaluate_series(series, at_ns), False).any())


def _series(address: str, record: Mapping[str, Batch]) -> tuple[IntArray, Any]:
    item, _, column = address.partition(".")
    name, bracket, place = column.partition("[")
    values = record[item].columns[name]
    if isinstance(values, Ragged) and bracket:
        values = values.values.reshape(len(values), -1)[:, int(place.rstrip("]"))]
    return record[item].log_time_ns, values


@pytest.mark.parametrize("fault", REACTIONS)
def test_monitors_react_as_the_failure_modes_say(
    fmea: Fmea, plan: MonitoringPlan, fault: str
) -> None:
    within_s = REACTIONS[fault]
    findings = find(plan, with_fault(fault, within_s + 1), FAULT_S + within_s)
    seen = {
        (t.component, t.mode) for t in failures(findings) if t.mode and t.after.level != "stale"
    }
    links = [k for k in fmea.modes[mode_of(fault, fmea)].symptoms if "/" in k.symptom]
    sure = {tuple(k.symptom.split("/")[:2]) for k in links if k.detects >= 0.9}
    possible = {tuple(k.symptom.split("/")[:2]) for k in links}
    assert sure <= seen <= possible
