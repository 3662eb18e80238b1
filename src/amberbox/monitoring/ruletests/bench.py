"""A mode on the bench: tested alone, without a robot; what is recorded is what the tests say."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator, Mapping
from contextlib import suppress
from pathlib import Path

from amberbox.blackbox.folder.robot import RobotConfig
from amberbox.core.errors import Problem, UsageError
from amberbox.core.names import identifier
from amberbox.core.nodes import Node
from amberbox.core.source import TopicOptions
from amberbox.core.types import Column, ItemSchema
from amberbox.monitoring.configuration.functions import find_functions
from amberbox.monitoring.configuration.inputs import Inputs
from amberbox.monitoring.configuration.modes import Bench, plan_mode
from amberbox.monitoring.configuration.recorded import Item, Recorded
from amberbox.monitoring.configuration.tree import ModeSource
from amberbox.monitoring.configuration.variables import guessed
from amberbox.monitoring.plan import ComponentPlan, Plan
from amberbox.monitoring.ruletests.files import RuleFile
from amberbox.monitoring.ruletests.notation import ABSENT, Series
from amberbox.monitoring.ruletests.rows import column_of

COMPONENT = "tested"
"""The component that a mode on the bench belongs to."""


def bench_plan(mode: Node, file: RuleFile, folder: Path) -> tuple[Plan, list[Problem]]:
    """Make a plan of one mode, and say what is wrong with it.

    ``folder`` is a robot folder, for the monitors and probes of its own.
    """
    problems: list[Problem] = []
    functions = find_functions(folder)
    bench = Bench(functions, Inputs(_Told(file), functions), RobotConfig(), problems)
    plan = plan_mode(ModeSource(Path(mode.file), mode), bench)
    component = ComponentPlan(COMPONENT, COMPONENT, (plan,))
    return Plan("rule_test", "", (component,)), problems


class _Told(Recorded):
    """The items that tests name, with the columns that they give them."""

    def __init__(self, file: RuleFile) -> None:
        self.items = tuple(_items(file))
        self.open = ()

    def schema(self, item: Item) -> ItemSchema | None:
        return item.schema

    def stored(self, name: str) -> ItemSchema | None:
        return None

    def rate_hz(self, name: str) -> float | None:
        return None


def _items(file: RuleFile) -> Iterator[Item]:
    columns: dict[str, dict[str, str]] = defaultdict(dict)
    for test in file.tests:
        for name, series in test.series.items():
            item, _, variable = name.strip("/").partition(".")
            place = guessed(item, variable) if "[" in variable else None
            if place is not None and place.number is not None:
                columns[place.item][place.variable] = "list<float64>"
            else:
                columns[item] |= dict(_types({variable: series}))
        for item, rows in test.rows.items():
            columns[item.strip("/")] |= dict(_types(rows))
        for name in (*test.received, *test.stamps, *(loss.item for loss in test.lost)):
            columns[name.strip("/")] |= {}
    for name, types in columns.items():
        types.pop("", None)
        if identifier(name) == name:
            schema = ItemSchema("rule test", tuple(Column(n, n, t) for n, t in types.items()))
            yield Item(name, "", f"/{name}", TopicOptions(name), schema)


def _types(columns: Mapping[str, Series]) -> Iterator[tuple[str, str]]:
    """Yield columns with their types."""
    for name, series in columns.items():
        with suppress(UsageError):  # said when the test runs
            yield name, column_of(name, [v for v in series.values if v is not ABSENT])[0]
