"""The page of a robot: components, times, missions, and its contents by role."""

from __future__ import annotations

import html
import math
import re
from collections.abc import Iterator
from dataclasses import replace
from typing import Any, cast

import pytest

from amberbox.core.api import (
    Component,
    Condition,
    Lane,
    Mode,
    Need,
    Output,
    StatusTree,
    Stretch,
    Timeline,
)
from amberbox.core.clock import NS
from amberbox.server import annotations as server_annotations
from amberbox.server.live.facts import FactsCache
from amberbox.server.web import components, robot
from amberbox.server.web.components import as_list, edges, graph, groups
from amberbox.server.web.robot import times
from amberbox.server.workers.pool import WorkerPool
from tests.server.house import START_NS, House, house
from tests.server.state import lives

AT_7 = "2027-01-15T07:00:00Z"
PAGE = "/robots/ropod_001"
PIECES = "/pieces/robots/ropod_001"
HOSTILE = '"><img src=x onerror=alert(1)>{{7*7}}'


@pytest.fixture(scope="module")
def home(tmp_path_factory: pytest.TempPathFactory) -> Iterator[House]:
    """One robot has a laser that is dead, one no folder, one was never there."""
    with house(tmp_path_factory.mktemp("house"), shared=True) as found:
        lives.keep_folder(found, "ropod_001")
        lives.connect(found, "ropod_001", config_hash=lives.HASH)
        lives.connect(found, "ropod_002", config_hash="cd" * 32)
        working = {"name": "front_laser_working", "type": "bool", "value": 0}
        rate = {"name": "rate_hz", "type": "float", "value": 9.87654}
        said = [
            lives.status("laser", "error", START_NS, reason="the device is gone"),
            lives.status("laser", "error", START_NS, mode="laser_device_monitor",
                         state="front_laser_working", outputs=[working, rate]),
            lives.status("navigation", "error", START_NS, blocked_by=["laser"],
                         reason="needs laser"),
        ]  # fmt: skip
        for seq, values in enumerate(said, 1):
            lives.say(found, "ropod_001", lives.STATUS, START_NS, seq, values)
        event = lives.transition("laser", "ok", "error", START_NS - 600 * NS)
        lives.say(found, "ropod_001", lives.EVENT, START_NS - 600 * NS, 4, event)
        odd = lives.status(HOSTILE, "warn", START_NS, reason=HOSTILE)
        lives.say(found, "ropod_002", lives.STATUS, START_NS, 1, odd)
        remark = {"kind": "remark", "text": HOSTILE, "source": "watch", "details": ""}
        lives.say(found, "ropod_002", lives.EVENT, START_NS - NS, 2, remark)
        page(found, f"{PIECES}/tree")  # now its folder is known
        yield found


def page(home: House, path: str = PAGE, name: str = "viewer") -> str:
    answer = home.client(name).get(path)
    assert answer.status_code == 200, answer.text
    return str(answer.text)


def text_of(markup: str) -> str:
    return " ".join(html.unescape(re.sub(r"<[^>]+>", " ", markup)).split())


def branch(markup: str, component: str) -> str:
    """Return the markup of a component with its children."""
    found = re.search(rf'data-component="{component}".*?(?=<div class="branch"|id="tree-keys")',
                      markup, re.DOTALL)  # fmt: skip
    assert found, component
    return found[0]


def test_a_component_shows_its_checks_values_and_what_was_expected(home: House) -> None:
    words = text_of(branch(page(home), "laser"))
    assert "Laser error the device is gone" in words
    assert "What it is sees obstacles" in words
    assert "front_laser_working no expected yes" in words
    assert "rate_hz 9.877 Hz" in words


def test_who_suffers_names_what_is_in_the_way_and_what_it_needs(home: House) -> None:
    words = text_of(branch(page(home), "navigation"))
    assert re.search(r"Blocked by (What “blocked” means )?Laser", words), words
    assert "Needs Laser error" in words


def test_where_nobody_chose_the_root_of_trouble_is_open(home: House) -> None:
    shown = page(home)
    assert 'aria-expanded="true"' in branch(shown, "laser")
    assert 'aria-expanded="true"' not in branch(shown, "navigation")


def test_what_is_open_stands_in_the_address(home: House) -> None:
    shown = page(home, f"{PAGE}?open=navigation")
    assert 'aria-expanded="true"' in branch(shown, "navigation")
    assert 'aria-expanded="true"' not in branch(shown, "laser")
    assert 'aria-expanded="true"' not in page(home, f"{PAGE}?open=-")


@pytest.mark.parametrize(
    ("query", "seen"),
    [("q=front_laser_work", ["laser"]), ("show=trouble", ["laser", "navigation"]),
     ("q=nowhere", []), ("q=NAVI&show=trouble", ["navigation"])],
)  # fmt: skip
def test_one_finds_what_one_looks_for(home: House, query: str, seen: list[str]) -> None:
    shown = page(home, f"{PAGE}?{query}")
    found = re.findall(r'data-component="(\w+)" data-level="\w+">', shown)
    assert sorted(found) == seen
    assert ('id="nothing-fits">' in shown) == (not seen)


def test_the_graph_marks_the_root_and_leads_to_the_tree(home: House) -> None:
    shown = page(home, f"{PIECES}/graph")
    assert 'class="node level-error root"' in shown
    assert 'href="#c-laser"' in shown
    assert "Laser (cause) error Navigation" in text_of(shown)


def test_what_was_when_leads_to_the_data_of_that_time(home: House) -> None:
    shown = page(home, f"{PIECES}/timeline?window=6h")
    assert 'class="stretch state-error"' in shown
    assert "/robots/ropod_001/data?from=2027-01-15T07" in shown


def test_events_can_be_chosen_by_their_kind(home: House) -> None:
    assert "laser: ok -> error" in text_of(page(home, f"{PIECES}/events?kind=component_state"))
    none = page(home, f"{PIECES}/events?kind=bump")
    assert "No event of this kind" in none


def test_a_robot_that_never_connected_says_what_to_do(home: House) -> None:
    path = "/robots/ropod_003"
    assert "This robot has never connected" in page(home, path)
    assert 'href="/admin/robots"' not in page(home, path).split("<main")[1]
    assert 'href="/admin/robots"' in page(home, path, "admin").split("<main")[1]


def test_a_robot_without_its_folder_says_so(home: House) -> None:
    words = text_of(page(home, "/robots/ropod_002"))
    assert "The robot's folder is not here yet." in words
    assert "What needs what stands in the robot's folder" in words


def test_hostile_names_and_reasons_are_text(home: House) -> None:
    for path in ("", "/tree", "/graph", "/timeline", "/events", "/panels", "/now", "/head"):
        base = "/robots/ropod_002" if not path else "/pieces/robots/ropod_002"
        shown = page(home, f"{base}{path}")
        assert "<img" not in shown, path
        assert "49" not in text_of(shown).split(), path
    assert HOSTILE in html.unescape(page(home, "/robots/ropod_002"))


def test_operators_act_and_viewers_look(home: House) -> None:
    assert "data-act" not in page(home)
    acts = set(re.findall(r'data-act="(\w+)"', page(home, PAGE, "operator")))
    assert acts == {"incident", "begin"}


def test_a_mission_that_people_began_can_be_ended_and_noted(home: House) -> None:
    with home.services.database.begin() as connection:
        begun = server_annotations.begin(connection, START_NS, "ropod_001", "demo", "operator", {})
    shown = page(home, f"{PIECES}/now", "operator")
    base = f"/api/v1/robots/ropod_001/missions/{begun.id}"
    assert f'data-path="{base}/end"' in shown
    assert f'data-path="{base}/notes"' in shown
    assert f"{base}/end" not in page(home, f"{PIECES}/now")
    with home.services.database.begin() as connection:
        server_annotations.end(connection, START_NS + 1, "ropod_001", begun.id, "done", failed=None)


def test_files_of_the_folder_are_for_technicians_when_they_open_them(home: House) -> None:
    piece = f"{PIECES}/files"
    link = f'href="/api/v1/robots/ropod_001/folder/{lives.HASH}/robot.yaml"'
    shown = page(home, name="technician")
    assert f'data-fill="{piece}"' in shown and link not in shown
    assert link in page(home, piece, "technician")
    assert piece not in page(home) and home.client("viewer").get(piece).status_code == 403


def test_a_page_waits_for_no_worker(home: House, monkeypatch: pytest.MonkeyPatch) -> None:
    state = home.services.feed.state
    unread = FactsCache(home.services.folders, cast("WorkerPool", None))
    monkeypatch.setattr(state, "facts", unread)
    monkeypatch.setattr(state, "cards", replace(state.cards, facts=unread))
    shown = page(home, f"{PAGE}?q=las&open=laser")
    assert 'data-component="laser"' in shown and "The robot's folder is not here" not in shown
    assert f'data-fill="{PIECES}/tree?q=las&amp;open=laser"' in shown
    assert all(f'data-fill="{PIECES}/{name}"' in shown for name in ("panels", "graph"))


def test_what_is_filled_in_waits_for_nothing_more(home: House) -> None:
    for name in ("tree", "panels", "graph"):
        assert "data-fill" not in page(home, f"{PIECES}/{name}")
    assert "data-fill" not in page(home)


def test_a_token_for_statuses_alone_sees_neither_events_nor_diagnoses(home: House) -> None:
    shown = home.token_client("technician", "read:status").get(PAGE)
    assert shown.status_code == 200
    assert 'id="tree"' in shown.text
    assert 'id="events"' not in shown.text
    assert 'id="diagnosis"' not in shown.text


def test_the_head_says_that_a_robot_is_silent(home: House) -> None:
    link = home.services.links.robots["ropod_001"]
    last_received_s = link.last_received_s
    link.last_received_s = -math.inf
    try:
        assert "silent since" in page(home, f"{PIECES}/head")
        assert "is-silent" in page(home)
    finally:
        link.last_received_s = last_received_s
    assert "online" in page(home, f"{PIECES}/head")


# -- what it is made of


@pytest.mark.parametrize(
    ("value", "text"),
    [(0.0, "0.000"), (0.01, "0.010"), (24.2, "24.20"), (-64.5, "-64.50"), (999.96, "1000.0"),
     (5400.0, "5400"), (123456.7, "123457"), (2.5e6, "2.50e+06"), (1.5e-5, "1.50e-05")],
)  # fmt: skip
def test_numbers_have_digits_that_tell_something(value: float, text: str) -> None:
    assert components.number(value) == text


@pytest.mark.parametrize(
    ("name", "unit"),
    [("rate_hz", "Hz"), ("volts", "V"), ("time_to_empty", ""), ("m", ""), ("left_m", "m"),
     ("charge_percent", "%"), ("a", ""), ("kelvin_per_s", ""), ("per_s", ""), ("paper_s", "s")],
)  # fmt: skip
def test_units_are_read_from_names(name: str, unit: str) -> None:
    assert components.guessed_unit(name) == unit


@pytest.mark.parametrize(
    ("name", "type", "declared", "label", "unit"),
    [("rate_hz", "float", "", "rate", "Hz"), ("charge", "float", "%", "charge", "%"),
     ("mb_per_s", "float", "MB/s", "mb per s", "MB/s"),
     ("over_voltage", "bool", "", "over voltage", ""),
     ("supply_voltage", "float", "V", "supply voltage", "V"), ("age_s", "float", "", "age", ""),
     ("left_m", "float", "mm", "left m", "mm")],
)  # fmt: skip
def test_a_unit_is_declared_else_guessed_and_not_said_twice(
    name: str, type: str, declared: str, label: str, unit: str
) -> None:
    output = Output(name, type, 1.0, "", "", "", declared)
    assert (components.label(output), components.unit(output)) == (label, unit)


@pytest.mark.parametrize(
    ("seconds", "text"),
    [(0.1, "0.100 s"), (119.0, "119.0 s"), (120.0, "2 min"), (3725.0, "1 h 2 min"),
     (49887.0, "13 h 51 min"), (90061.0, "1 d 1 h"), (-200.0, "-3 min 20 s")],
)  # fmt: skip
def test_numbers_of_seconds_are_durations(seconds: float, text: str) -> None:
    assert components.shown(Output("time_to_empty", "float", seconds, "", "", "", "s")) == text
    assert components.shown(Output("left_s", "float", None, "", "", "")) != text


@pytest.mark.parametrize(
    ("seconds", "text"), [(0.0, "1 s"), (59.9, "59 s"), (61, "1 min"), (7300, "2 h"), (9e5, "10 d")]
)
def test_ages_are_told_in_one_unit(seconds: float, text: str) -> None:
    assert components.span_text(seconds) == text


def condition(level: str, *blocked_by: str) -> Condition:
    return Condition(level, level, "", blocked_by, None, None, 0.0, 0.0)


def component(
    name: str, level: str = "ok", *, needs: tuple[str, ...] = (), part_of: str = "",
    blocked_by: tuple[str, ...] = (), outputs: tuple[Output, ...] = (),
) -> Component:  # fmt: skip
    modes = [Mode("m", "m", condition(level), outputs)] if outputs else []
    needed = [Need(one, one, "ok") for one in needs]
    said = condition(level, *blocked_by)
    return Component(name, name, 0, "", part_of, needed, "", (), said, modes)


def test_of_many_in_trouble_the_worst_roots_are_open() -> None:
    parts = [component("a", "warn"), component("b", "error", blocked_by=("a",)), component("c"),
             *(component(f"d{n}", "error") for n in range(3))]  # fmt: skip
    tree = StatusTree("r", True, "", "", None, parts)
    opened = [
        one.component.component for one in components.branches(tree, "", "all", ()) if one.is_open
    ]
    assert opened == ["d0", "d1", "d2"]


def test_components_that_are_alike_stand_side_by_side() -> None:
    volts, on = Output("volts", "float", 24.0, "", "", ""), Output("on", "bool", True, "", "", "")
    wheels = [component(f"wheel_{name}", outputs=(on, volts)) for name in ("left", "right")]
    (group,) = groups([*wheels, component("wheelhouse", outputs=(on,)), component("imu")])
    assert (group.name, [one.rest for one in group.members]) == ("wheel", ["left", "right"])
    assert group.columns == [("m", "volts"), ("m", "on")]


def test_the_graph_has_each_line_once_and_none_to_itself() -> None:
    parts = [component("a", needs=("b", "b", "a", "nowhere"), part_of="b"), component("b")]
    assert [(one.start, one.end, one.kind) for one in edges(parts)] == [("a", "b", "needs")]
    assert [line.needed_by for line in as_list(parts)] == [[], ["A"]]
    assert graph([component("a"), component("b")], "x") is None


def test_lanes_that_were_fine_are_counted_and_shown_on_demand() -> None:
    def lane(name: str, level: str) -> Lane:
        one = Stretch(from_="2027-01-15T07:00:00Z", to="2027-01-15T08:00:00Z", level=level,
                      state=level, reason="", changes=0)  # fmt: skip
        return Lane(component=name, mode="", stretches=[one])

    found = timeline_of(lane("a", "ok"), lane("b", "stale"))
    some, every = times("r", found, "", {}), times("r", found, "all", {"a": "The front"})
    assert (some.shown, some.fine, every.shown) == (1, 1, 2)
    assert [row.component for row in every.rows] == ["b"]
    assert "The front" in str(every.drawing) and ">B<" in str(every.drawing)


def timeline_of(*lanes: Lane) -> Timeline:
    """Make a timeline of an hour."""
    return Timeline(from_=AT_7, to="2027-01-15T08:00:00Z", complete=True, lanes=list(lanes))


def stretches(*found: tuple[str, str, str]) -> list[Stretch]:
    """Make intervals of from, to and level; times are given as hours and minutes."""
    return [
        Stretch(from_=f"2027-01-15T{start}:00Z", to=f"2027-01-15T{to}:00Z", level=level,
                state=level, reason="", changes=0)
        for start, to, level in found
    ]  # fmt: skip


def test_time_begins_with_the_first_word() -> None:
    late = Lane(
        component="a",
        mode="",
        stretches=stretches(
            ("07:00", "07:40", "unknown"), ("07:40", "07:50", "ok"), ("07:50", "08:00", "unknown")
        ),
    )
    fine = Lane(
        component="b",
        mode="",
        stretches=stretches(("07:00", "07:45", "unknown"), ("07:45", "08:00", "ok")),
    )
    mute = Lane(component="c", mode="", stretches=stretches(("07:00", "08:00", "unknown")))
    found = times("r", timeline_of(late, fine, mute), "", {})
    assert (found.known_from, found.shown, found.fine) == ("2027-01-15T07:40:00Z", 1, 1)
    assert [(row.component, row.stretch.from_[11:16]) for row in found.rows] == [("a", "07:50")]
    drawn = str(found.drawing)
    assert re.findall(r">(\w[^<]*ago|now)<", drawn) == [
        "now",
        "5 min ago",
        "10 min ago",
        "15 min ago",
        "20 min ago",
    ]
    assert 'x="0.000%" width="50.000%"' in drawn
    assert times("r", timeline_of(mute), "", {}).drawing is None


@pytest.mark.parametrize(
    ("type", "expected", "value", "is_met", "text"),
    [("bool", "true", True, True, "yes"), ("bool", "true", False, False, "yes"),
     ("bool", "false", False, True, "no"), ("bool", "!= true", True, False, "not yes"),
     ("float", ">= 5.0", 5, True, "at least 5 V"), ("float", "< 5.0", 5.0, False, "less than 5 V"),
     ("int", "1 to 3", 4, False, "1 V to 3 V"), ("float", "0.5", 0.5, True, "0.5 V"),
     ("string", "up", "down", False, "up"), ("string", "!= down", "up", True, "not down"),
     ("string", "1 to 3", "1 to 3", True, "1 to 3"), ("float", "up", 1.0, False, "up"),
     ("float", "> 1.0", None, True, "more than 1 V"), ("bool", "", False, True, "")],
)  # fmt: skip
def test_what_is_expected_is_said_as_values_are(
    type: str, expected: str, value: Any, is_met: bool, text: str
) -> None:
    output = Output("x", type, value, expected, "", "", "V")
    assert (components.is_met(output), components.text(output)) == (is_met, text)


def test_of_a_component_in_trouble_what_holds_is_folded() -> None:
    bad, good = (Output(name, "bool", name == "good", "true", "", "") for name in ("bad", "good"))
    well = Mode("well", "well", condition("ok"), [good])
    ill = Mode("ill", "ill", condition("error"), [bad, good])
    one = replace(component("a", "error"), modes=[well, ill])
    (branch_,) = components.branches(StatusTree("r", True, "", "", None, [one]), "", "all", ())
    assert branch_.holding == {("well", ""), ("well", "good"), ("ill", "good")}
    assert branch_.held == 2
    calmed = StatusTree("r", True, "", "", None, [replace(one, modes=[well])])
    (calm,) = components.branches(calmed, "", "all", ())
    assert not calm.holding


def test_a_check_that_is_good_again_heals() -> None:
    good = Output("good", "bool", True, "true", "", "")
    said = replace(condition("error"), state="good")
    assert components.is_healing(Mode("m", "m", said, [good]), good)
    assert not components.is_healing(Mode("m", "m", condition("ok"), [good]), good)
    bad = replace(good, value=False)
    assert not components.is_healing(Mode("m", "m", said, [bad]), bad)


@pytest.mark.parametrize(
    ("component", "name", "called"),
    [("wheel_rear_right", "wheel_rear_right", "Wheel rear right"), ("imu", "", "Imu"),
     ("w1", "rear right wheel", "Rear right wheel")],
)  # fmt: skip
def test_components_are_called_alike_everywhere(component: str, name: str, called: str) -> None:
    assert components.called(component, name) == called
    assert components.needs_id(component, called) == (component != "imu")


def test_of_a_battery_what_is_measured_stands_before_its_checks() -> None:
    def output(name: str, type: str, expected: str = "", unit: str = "") -> Output:
        return Output(name, type, type == "bool", expected, "", "", unit)

    outputs = (output("even", "bool", "true"), output("charge", "float"),
               output("pack_voltage", "float"), output("kelvin_per_s", "float", unit="K/s"),
               output("time_to_empty", "float", unit="s"), output("charging", "bool"),
               output("rate_hz", "float"))  # fmt: skip
    found = robot.battery_outputs(component("battery", outputs=outputs), "charge")
    assert found is not None and (found.checks, found.failing) == (1, False)
    measured = [one.name for _, one in found.measured]
    assert measured == ["pack_voltage", "time_to_empty", "charging"]
    assert [one.name for _, one in found.rest] == ["even", "kelvin_per_s", "rate_hz"]


def test_what_a_battery_records_is_told_by_units_and_names() -> None:
    columns = [
        {"name": name, "type": type, "unit": unit}
        for name, type, unit in (
            ("charger_voltage", "double", "V"), ("voltage", "double", "V"), ("t1", "float", "°C"),
            ("percentage", "double", ""), ("current", "string", ""), ("rate", "double", "K/s"),
            ("state.charging", "bool", ""), ("not_charging_well", "bool", ""))
    ]  # fmt: skip
    found = robot.quantities(columns)
    assert {name: one["name"] for name, one in found.items()} == {
        "charge": "percentage", "voltage": "voltage", "temperature": "t1"}  # fmt: skip
    assert robot.charging_of(columns) == "state.charging"
