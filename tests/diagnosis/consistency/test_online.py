"""Models over a record: the values of ports, and the failure modes of conflicts."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

import amberbox.sim
from amberbox.cli.main import main
from amberbox.core.clock import NS
from amberbox.core.contracts import Span
from amberbox.core.timestamps import format_time
from amberbox.diagnosis.consistency.components import Components, Step, load_components
from amberbox.diagnosis.consistency.online import (
    conflicts_of,
    mapped,
    observed_steps,
    possible_faults,
)
from amberbox.sim.robot import Robot
from benchmarks.missions import Batches
from benchmarks.providers import RecentPast
from tests.cli.diagnosed import Bench, write_folder

MODEL = """\
kind: components
types:
  relay:
    ports: {in: [on, off], out: [on, off]}
    modes:
      open: {nominal: true, constraints: ["out == off"]}
      closed: {nominal: true, constraints: ["out == in"]}
      welded: {constraints: ["out == in"]}
      burnt: {constraints: ["out == off"]}
    transitions:
      - {from: open, to: closed, when: "cmd == true"}
      - {from: closed, to: open, when: "cmd == false"}
components: {relay: relay}
observe:
  relay.in: {value: "supply.volts > 20", values: {true: on, false: off}}
  relay.out: {value: supply.state, max_age: 2}
commands:
  relay.cmd: drive.close
history: 4
"""


@dataclass
class Past:
    """A record of rows by item."""

    items: Mapping[str, Sequence[Mapping[str, Any]]]
    recorded: tuple[Span, ...] = ((0, 100 * NS),)
    watched: tuple[Span, ...] = ()
    span: Span = (0, 100 * NS)

    def rows(self, topic: str, names: Sequence[str], span: Span) -> Iterable[Mapping[str, Any]]:
        found = self.items.get(topic, ())
        return [row for row in found if span[0] <= row["received"] < span[1]]


def supply(at_s: float, state: str, volts: float = 24.0) -> dict[str, Any]:
    return {"received": round(at_s * NS), "volts": volts, "state": state}


@pytest.fixture
def model(tmp_path: Path) -> Components:
    path = tmp_path / "relay.yaml"
    path.write_text(MODEL)
    return load_components(path)


def test_values_are_those_that_have_settled(model: Components) -> None:
    rows = [supply(n / 2, "on" if n < 81 else "off") for n in range(85)]
    found = observed_steps(model, Past({"supply": rows}), round(42.3 * NS))
    assert [at / NS for at in found.times_ns] == [39, 40, 41, 42]
    outs = [step.observe.get("relay.out") for step in found.steps]
    assert outs == ["on", "on", None, "off"]  # it changed at 40.5
    assert [step.observe.get("relay.in") for step in found.steps] == ["on"] * 4
    assert not any(step.commands for step in found.steps)


def test_what_is_old_or_strange_is_not_known(model: Components) -> None:
    rows = [supply(38, "on"), supply(38.5, "on")]
    found = observed_steps(model, Past({"supply": rows}), 42 * NS)
    both = ["relay.in", "relay.out"]
    assert [[*step.observe] for step in found.steps] == [both, both, both[:1], both[:1]]
    rows = [supply(n, "half", float("nan")) for n in range(43)]
    assert observed_steps(model, Past({"supply": rows}), 42 * NS).is_empty
    assert observed_steps(model, Past({}), 42 * NS).is_empty
    begun = Past({"supply": [supply(n, "on") for n in range(43)]}, recorded=((41 * NS, 50 * NS),))
    assert len(observed_steps(model, begun, 42 * NS).steps) == 2
    assert observed_steps(model, Past({}, recorded=()), 42 * NS).is_empty


def test_commands_explain_what_changes(model: Components) -> None:
    on, off = {"relay.in": "on", "relay.out": "on"}, {"relay.in": "on", "relay.out": "off"}
    assert conflicts_of(model, [Step(off), Step(off), Step(on, {"relay.cmd": True})]) == ([], "")
    assert conflicts_of(model, [Step(off), Step(on)]) == ([["relay"]], "")
    assert conflicts_of(model, [Step(on), Step(on, {"relay.cmd": False})]) == ([["relay"]], "")


def test_failure_modes_of_a_conflict(model: Components, tmp_path: Path) -> None:
    modes = ["relay#burnt", "relay#loose", "motor#worn"]
    found, unmapped = mapped(model, model.faults, modes)  # welded stands for all of the relay
    assert found == {"relay#burnt", "relay#loose"} and unmapped == []
    assert mapped(model, ["relay=burnt"], modes)[0] == {"relay#burnt"}
    assert mapped(model, model.faults, ["motor#worn"]) == (
        frozenset(),
        ["relay=welded", "relay=burnt"],
    )
    path = tmp_path / "relay.yaml"
    path.write_text(MODEL + "maps_to: {relay=welded: [motor#worn], relay: [relay#burnt]}\n")
    assert mapped(load_components(path), model.faults, modes)[0] == {"relay#burnt", "motor#worn"}


def test_faults_that_the_observations_refute(tmp_path: Path) -> None:
    path = tmp_path / "lamp.yaml"
    path.write_text("""\
kind: components
types:
  lamp:
    ports: {on: [yes, no], warm: [yes, no]}
    modes:
      works: {nominal: true, constraints: ["on == warm"]}
      dark: {constraints: ["warm == no"]}
      hot: {constraints: ["warm == yes"]}
      unknown: {}
components: {left: lamp, right: lamp}
connections: [[left.on, right.on]]
""")
    lamps = load_components(path)
    seen = [Step({"left.on": "yes", "left.warm": "no"})]
    assert conflicts_of(lamps, seen) == ([["left"]], "")
    assert possible_faults(lamps, seen, ["left"]) == ["left=dark", "left=unknown"]
    assert possible_faults(lamps, seen, ["right"]) == ["right=dark", "right=hot", "right=unknown"]


def test_the_chain_of_the_simulated_robot() -> None:
    path = Path(amberbox.sim.__file__).parent / "folder" / "models" / "chain.yaml"
    chain = load_components(path)
    columns: dict[str, set[str]] = {}
    for binding in chain.observe.values():
        for address in binding.value.addresses():
            columns.setdefault(address.partition(".")[0], set()).add(address.partition(".")[2])
    faults = ("wheel_front_left_bus_disconnected", "navigation_hang", "bumper_switch_closed")
    found = []
    for planted in ((), faults):
        robot, past = Robot(5), RecentPast()
        for fault in planted:
            robot.inject(fault, 14.0)
        for batch in Batches(columns).of(list(robot.step_until(31.0))):
            past.feed(batch)
        past.end_ns = robot.now_ns
        observed = observed_steps(chain, past, robot.start_ns + 30 * NS)
        assert len(observed.steps[0].observe) > 40
        conflicts, _ = conflicts_of(chain, observed.steps)
        names = {name for conflict in conflicts for name in conflict}
        found.append((conflicts, possible_faults(chain, observed.steps, names)))
    assert found[0] == ([], [])
    assert found[1][0] == [["navigation"], ["safety"], ["wheel_front_left"]]
    known = [fault for fault in found[1][1] if not fault.endswith("=unknown")]
    assert {*known} >= {
        "navigation=hang", "safety=bumper_switch_closed", "wheel_front_left=bus_disconnected",
    }  # fmt: skip
    assert not {*known} & {"safety=e_stop_pressed", "wheel_front_left=power_stage_trips"}


def test_a_robot_folder_over_its_record(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    place = write_folder(tmp_path / "robot")
    (place / "models").mkdir()
    (place / "models" / "drive.yaml").write_text("""\
kind: components
types:
  motor:
    ports: {speed: [turns, stands]}
    modes: {ok: {nominal: true, constraints: ["speed == turns"]}, worn: {}}
components: {motor: motor}
observe:
  motor.speed: {value: ros_speed.data > 0, values: {true: turns, false: stands}, max_age: 2}
""")
    bench = Bench(place)
    bench.run(4)
    well_ns = bench.clock.wall_ns()
    bench.run(4, speed=0)
    bench.box.close()
    assert main(["consistency", str(place), "--at", format_time(well_ns - NS)]) == 0
    assert "observed: motor.speed=turns\nno fault" in capsys.readouterr().out
    assert main(["consistency", str(place), "drive"]) == 1
    shown = capsys.readouterr().out
    assert "observed: motor.speed=stands\ndiagnoses: 1\n  motor=worn  (rank 3)\n" in shown
    assert main(["consistency", str(place), "--json"]) == 1
    assert '"diagnoses": [\n        [\n          "motor=worn"' in capsys.readouterr().out
    assert main(["consistency", str(place), "drives"]) == 2
    assert "called 'drives'; did you mean 'drive'?" in capsys.readouterr().err
    assert main(["consistency", str(place), "--times"]) == 2
    (place / "models" / "drive.yaml").unlink()
    assert main(["consistency", str(place)]) == 2
    assert "there is no model of kind: components" in capsys.readouterr().err
