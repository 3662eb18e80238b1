"""Models whose modes change with time, against all trajectories."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import product
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from amberbox.core.contracts import Budget
from amberbox.core.expression import parse
from amberbox.diagnosis.consistency import recovery
from amberbox.diagnosis.consistency.components import Components, Step, load_components
from amberbox.diagnosis.consistency.engines import SolverName
from amberbox.diagnosis.consistency.history import History
from amberbox.diagnosis.consistency.question import ask
from amberbox.diagnosis.consistency.recovery import Goal
from amberbox.diagnosis.consistency.tracking import MARGIN, Tracker
from amberbox.diagnosis.consistency.trajectories import Moves
from tests.diagnosis.consistency.test_components import minimal

SOLVERS: list[SolverName] = ["python", "clingo"]
VALUES = ("low", "high")
RELATIONS = ("out == in", "out != in", "out == low", "in == high or out == low")
GUARDS = ("cmd == go", "in == high", "cmd == go and in == low", "not in == low", None)
State = tuple[str, ...]
Timed = frozenset[tuple[str, int]]  # faults with their steps


@st.composite
def models(draw: st.DrawFn) -> dict[str, object]:
    """Return a chain of one or two components that change their modes over up to three steps."""
    types, components, initial = {}, {}, {}
    for number in range(draw(st.integers(1, 2))):
        relations = st.lists(st.sampled_from(RELATIONS), max_size=1)
        modes: dict[str, object] = {
            "idle": {"nominal": True, "constraints": draw(relations)},
            "busy": {"nominal": True, "constraints": draw(relations)},
        }
        for mode in ("stuck", "lost")[: draw(st.integers(0, 2))]:
            probability = draw(st.sampled_from([0.1, 0.01, 0.001]))
            modes[mode] = {"probability": probability, "constraints": draw(relations)}
        transitions = []
        for _ in range(draw(st.integers(0, 3))):
            one: dict[str, object] = {"to": draw(st.sampled_from([*modes]))}
            one["from"] = draw(st.sampled_from(["idle", "busy", ["idle", "busy"], "*"]))
            when = draw(st.sampled_from(GUARDS))
            transitions.append(one | ({} if when is None else {"when": when}))
        transitions.append({"from": "idle", "to": "busy", "when": "cmd == go"})
        types[f"t{number}"] = {
            "ports": {"in": [*VALUES], "out": [*VALUES]}, "modes": modes,
            "transitions": transitions,
        }  # fmt: skip
        components[f"c{number}"] = f"t{number}"
        if draw(st.booleans()):
            initial[f"c{number}"] = draw(st.sampled_from(["idle", "busy"]))
    ports = [f"{name}.{port}" for name in components for port in ("in", "out")]
    seen = st.dictionaries(st.sampled_from(ports), st.sampled_from(VALUES))
    commands = st.dictionaries(st.sampled_from([f"{n}.cmd" for n in components]), st.just("go"))
    step = st.fixed_dictionaries({"observe": seen, "commands": commands})
    return {
        "kind": "components", "types": types, "components": components, "initial": initial,
        "connections": [["c0.out", "c1.in"]] if len(components) > 1 else [],
        "steps": draw(st.lists(step, min_size=1, max_size=3)),
    }  # fmt: skip


@dataclass
class Oracle:
    """All trajectories of a model as it is written in a file."""

    model: dict[str, object]
    found: dict[Timed, set[State]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.types: dict[str, dict[str, object]] = self.model["types"]  # type: ignore[assignment]  # YAML
        self.components: dict[str, str] = self.model["components"]  # type: ignore[assignment]  # YAML
        self.steps: list[dict[str, dict[str, str]]] = self.model["steps"]  # type: ignore[assignment]  # YAML

        constraints = str([mode.get("constraints") for mode in self.modes(0).values()])
        seen = any("c0.in" in step["observe"] for step in self.steps)
        # What only conditions read is a command, and nobody gives this one.
        self.is_command = "in" not in constraints and not seen

    def kind(self, number: int) -> dict[str, object]:
        return self.types[[*self.components.values()][number]]

    def modes(self, number: int) -> dict[str, dict[str, object]]:
        found: dict[str, dict[str, object]] = self.kind(number)["modes"]  # type: ignore[assignment]  # YAML
        return found

    def values(
        self, state: State, seen: Mapping[str, str], commands: Mapping[str, str]
    ) -> Iterator[list[dict[str, str]]]:
        """Yield the values by component and port that agree with modes and observation."""
        for row in product(VALUES, repeat=2 * len(state)):
            of = [
                {"in": row[2 * n], "out": row[2 * n + 1], "cmd": commands.get(f"c{n}.cmd", "none")}
                for n in range(len(state))
            ]
            joined = len(state) == 1 or of[0]["out"] == of[1]["in"]
            named = {
                f"c{n}.{port}": value for n, ports in enumerate(of) for port, value in ports.items()
            }
            if not joined or any(named[name] != value for name, value in seen.items()):
                continue
            if all(
                holds(c, of[n]) for n, mode in enumerate(state) for c in self.constraints(n, mode)
            ):
                if self.is_command:
                    of[0]["in"] = None  # type: ignore[assignment]  # no value
                yield of

    def constraints(self, number: int, mode: str) -> Sequence[str]:
        found: Sequence[str] = self.modes(number)[mode].get("constraints", ())  # type: ignore[assignment]  # YAML
        return found

    def next_modes(self, number: int, mode: str, values: Mapping[str, str]) -> set[str]:
        """Return the modes that may follow without a fault."""
        found = set()
        for one in self.kind(number)["transitions"]:  # type: ignore[attr-defined]  # YAML
            sources = [one["from"]] if isinstance(one["from"], str) else one["from"]
            if ("*" in sources or mode in sources) and holds(one.get("when"), values):
                found.add(one["to"])
        return found or {mode}

    def after(
        self, state: State, seen: Mapping[str, str], commands: Mapping[str, str]
    ) -> set[tuple[State, frozenset[str]]]:
        """Return the states that may follow, each with the faults that happened."""
        found = set()
        for values in self.values(state, seen, commands):
            choices = []
            for number, mode in enumerate(state):
                options = [(name, "") for name in self.next_modes(number, mode, values[number])]
                options += [(m, f"c{number}={m}") for m, what in self.modes(number).items()
                            if "nominal" not in what]  # fmt: skip
                choices.append(options)
            for chosen in product(*choices):
                faults = frozenset(fault for _, fault in chosen if fault)
                found.add((tuple(mode for mode, _ in chosen), faults))
        return found

    def run(self) -> None:
        """Find all timed sets of faults that agree with the steps, with the states they end in."""
        initial: dict[str, str] = self.model["initial"]  # type: ignore[assignment]  # YAML
        begin = [
            [initial[name]] if name in initial else ["idle", "busy"] for name in self.components
        ]
        layer: dict[Timed, set[State]] = {frozenset(): set(product(*begin))}
        seen: Mapping[str, str] = {}
        for number, step in enumerate(self.steps, 1):
            new: dict[Timed, set[State]] = {}
            for timed, states in layer.items():
                for state in states:
                    for after, faults in self.after(state, seen, step["commands"]):
                        if any(self.values(after, step["observe"], {})):
                            key = timed | {(fault, number) for fault in faults}
                            new.setdefault(key, set()).add(after)
            layer, seen = new, step["observe"]
        self.found = layer

    def rank(self, timed: Timed) -> int:
        ranks = {0.1: 1, 0.01: 2, 0.001: 3}
        total = 0
        for fault, _ in timed:
            name, _, mode = fault.partition("=")
            total += ranks[self.modes(int(name[1:]))[mode]["probability"]]  # type: ignore[index]  # YAML
        return total

    def by_names(self) -> dict[frozenset[str], tuple[int, list[Timed]]]:
        """Return the sets of faults with their least rank and the ways of that rank."""
        found: dict[frozenset[str], tuple[int, list[Timed]]] = {}
        for timed in self.found:
            names, rank = frozenset(fault for fault, _ in timed), self.rank(timed)
            known = found.get(names, (rank, []))
            if rank < known[0]:
                known = rank, []
            found[names] = (known[0], [*known[1], timed] if rank == known[0] else known[1])
        return found


def holds(text: object, values: Mapping[str, str]) -> bool:
    if text is None:
        return True
    words = {word: word for word in (*VALUES, "go")}
    return bool(parse(str(text)).evaluate(words | dict(values)))


def check_questions(model: Components, oracle: Oracle, solver: SolverName) -> None:
    sets = oracle.by_names()
    diagnoses = minimal([set(names) for names in sets])
    history = History.of(model, model.steps, Budget())
    found = ask(history.question(Budget(), solver), "subset", 1_000, Budget())
    assert [names for _, names in found.diagnoses] == diagnoses
    assert [rank for rank, _ in found.diagnoses] == [sets[frozenset(n)][0] for n in diagnoses]
    few = [names for names in diagnoses if len(names) == len(diagnoses[0])]
    by_size = ask(history.question(Budget(), solver), "cardinality", 1_000, Budget()).diagnoses
    assert [names for _, names in by_size] == few
    least = min((rank for rank, _ in sets.values()), default=None)
    likely = minimal([set(names) for names, (rank, _) in sets.items() if rank == least])
    by_rank = ask(history.question(Budget(), solver), "rank", 1_000, Budget()).diagnoses
    assert by_rank == [(least, names) for names in likely]
    able = [n for n, name in enumerate(oracle.components) if len(oracle.modes(n)) > 2]
    faulty = [{fault.partition("=")[0] for fault in names} for names in sets]
    conflicts = [
        {f"c{n}" for n, take in zip(able, row, strict=True) if take}
        for row in product((False, True), repeat=len(able))
    ]
    assert found.conflicts == minimal([c for c in conflicts if all(c & of for of in faulty)])
    moves = Moves(model, Budget())
    for rank, names in found.diagnoses:
        times, ways = history.times(moves, names, rank), sets[frozenset(names)][1]
        assert times.variants == len(ways)
        steps = {name: [at for way in ways for fault, at in way if fault == name] for name in names}
        assert times.first == {name: min(at) for name, at in steps.items()}
        assert times.last == {name: max(at) for name, at in steps.items()}
        assert times.states == {state for way in ways for state in oracle.found[way]}


def load(path: Path, model: Mapping[str, object]) -> Components:
    path.write_text(json.dumps(model))
    return load_components(path)


@pytest.mark.parametrize("solver", SOLVERS)
def test_random_models_against_all_trajectories(tmp_path: Path, solver: SolverName) -> None:
    @settings(max_examples=20, suppress_health_check=list(HealthCheck))
    @given(models())
    def check(drawn: dict[str, object]) -> None:
        oracle = Oracle(drawn)
        oracle.run()
        check_questions(load(tmp_path / "model.yaml", drawn), oracle, solver)

    check()


def test_a_tracker_has_the_same_answer_and_with_a_short_history_only_right_ones(
    tmp_path: Path,
) -> None:
    @settings(max_examples=20, suppress_health_check=list(HealthCheck))
    @given(models())
    def check(drawn: dict[str, object]) -> None:
        oracle = Oracle(drawn)
        oracle.run()
        sets = oracle.by_names()
        for history in (0, 1):
            model = load(tmp_path / "model.yaml", drawn | {"history": history})
            tracker = Tracker(model)
            for step in model.steps:
                tracker.take(step)
            assert tracker.explanations is not None
            found = [frozenset(one.names) for one in tracker.explanations]
            assert set(found) <= sets.keys()
            if not history:
                least = min((one.rank for one in tracker.explanations), default=0)
                ranks = {of: sum(oracle.rank(frozenset({(n, 1)})) for n in of) for of in sets}
                every = [frozenset(names) for names in minimal([set(names) for names in sets])]
                assert {*found} == {of for of in every if ranks[of] <= least + MARGIN}

    check()


def test_plans_against_all_commands(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(recovery, "MOST_COMMANDED", 2)

    @settings(max_examples=12, suppress_health_check=list(HealthCheck))
    @given(models(), st.data())
    def check(drawn: dict[str, object], data: st.DataObject) -> None:
        model = load(tmp_path / "model.yaml", drawn)
        oracle = Oracle(drawn)
        choices = [("idle", "busy")] * len(oracle.components)
        states = data.draw(st.lists(st.sampled_from([*product(*choices)]), min_size=1, max_size=2))
        name = data.draw(st.sampled_from([*oracle.components]))
        port = f"{name}.out"
        goals = [Goal({name: "busy"}, {}), Goal({}, {port: "high"}), Goal({}, {port: "low"})]
        goal = data.draw(st.sampled_from(goals))
        plans = [
            plan
            for length in range(3)
            for plan in product(_all_commands(oracle), repeat=length)
            if all(_is_certain(oracle, state, plan, goal) for state in states)
        ]
        found = recovery.find_plan(model, states, Step(), goal, Budget())
        if found.plan is None:
            assert found.incomplete or not plans
            return
        best = min((len(plan), sum(map(len, plan))) for plan in plans)
        assert (len(found.plan), sum(map(len, found.plan))) == best
        assert tuple(dict(step) for step in found.plan) in plans

    check()


def _all_commands(oracle: Oracle) -> list[dict[str, str]]:
    names = [f"{name}.cmd" for name in oracle.components]
    rows = product((False, True), repeat=len(names))
    return [{n: "go" for n, take in zip(names, row, strict=True) if take} for row in rows]


def _is_certain(
    oracle: Oracle, state: State, plan: Sequence[Mapping[str, str]], goal: Goal
) -> bool:
    """Tell whether a plan is possible, and everything that may follow is the goal.

    What follows has to be possible to its end: a state without values is none.
    """
    layer = {state}
    for commands in plan:
        layer = {
            after
            for one in layer
            for after, faults in oracle.after(one, {}, commands)
            if not faults and any(oracle.values(after, {}, {}))
        }
    ends = [(one, of) for one in layer for of in oracle.values(one, {}, {})]
    if not ends:
        return False
    for one, of in ends:
        modes = dict(zip(oracle.components, one, strict=True))
        if any(modes[name] != mode for name, mode in goal.modes.items()):
            return False
        for name, value in goal.values.items():
            component, _, port = name.partition(".")
            if of[int(component[1:])][port] != value:
                return False
    return True
