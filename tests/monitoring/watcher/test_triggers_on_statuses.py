"""Triggers on records of the watcher, which are written slightly later than the data."""

from __future__ import annotations

import struct
from pathlib import Path

import pytest

from amberbox.blackbox.retention.incidents import IncidentMaintenance
from amberbox.blackbox.robot_folder.robot_yaml import RetentionOptions, Trigger
from amberbox.blackbox.store.derived_journal import DerivedJournal
from amberbox.blackbox.store.incident import load_all
from amberbox.blackbox.store.store import open_store
from amberbox.core.clock import NS
from tests.monitoring.watcher.diagnoser import PlainDiagnoser
from tests.monitoring.watcher.stand import NUMBERS, Stand, plan_of

ALARM = Trigger(
    "alarm",
    when="amberbox_alarm.state == 'open' and not amberbox_alarm.live_only",
    before_s=1,
    after_s=0.5,
)
OPENED = Trigger(
    "opened",
    when=f"{ALARM.when} and amberbox_alarm.changed_ns == amberbox_alarm.opened_ns",
    before_s=1,
    after_s=0.5,
)
DIAGNOSED = Trigger("diagnosed", when="amberbox_diagnosis.state == 'open'", before_s=1, after_s=0.5)
STATUS = Trigger(
    "status", when="amberbox_status.level == 'error'", before_s=1, after_s=0.5, hold_off_s=600
)
OUTPUT = Trigger("output", when="base/m/good == false for 500ms", before_s=1, after_s=0.5)
MODE = Trigger("mode", when="status(base/m) == 'error'", before_s=1, after_s=0.5)
PART = Trigger("part", when="status(base) == 'error' and ros_main.data < 0", before_s=1)
TRANSITION = Trigger("transition", event="component_state", before_s=1, after_s=0.5, hold_off_s=600)


@pytest.mark.parametrize(
    ("trigger", "killed"),
    [
        (ALARM, True),
        (OPENED, False),
        (DIAGNOSED, False),
        (STATUS, False),
        (OUTPUT, True),
        (MODE, False),
        (PART, True),
        (TRANSITION, False),
    ],
)
def test_a_trigger_on_a_status_makes_an_incident(
    tmp_path: Path, trigger: Trigger, killed: bool
) -> None:
    """The keeper has always read the recorder's rows long before the watcher writes."""
    stand = Stand(tmp_path / "store", diagnoser=PlainDiagnoser)
    options = RetentionOptions(triggers=(trigger,))
    store = open_store(stand.path)
    stand.box.write()
    keeper = IncidentMaintenance(store, options, DerivedJournal(store, "keep", clock=stand.clock))
    watcher = stand.watcher(plan_of())
    value, fell_ns = 1.0, 0
    for number in range(60):
        if number == 30:
            value, fell_ns = -1.0, stand.clock.wall
        for topic in NUMBERS.values():
            stand.box.hear(topic, struct.pack("<d", value))
        stand.box.write()
        keeper.step()
        if killed and number == 40:
            keeper.close()
            keeper = IncidentMaintenance(
                store, options, DerivedJournal(store, "keep", clock=stand.clock)
            )
        if number < 20 or number % 15 == 0:  # late by more than a second
            watcher.step()
    watcher.step()
    stand.box.write(1.0)
    keeper.step()
    watcher.close()
    stand.box.close()
    (incident, *_) = load_all(store)
    (reason, *_) = incident.reasons
    assert reason.trigger == trigger.name
    if trigger is not TRANSITION:
        assert 0 <= reason.at_ns - fell_ns <= 3 * NS
