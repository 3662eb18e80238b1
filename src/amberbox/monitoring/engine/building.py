"""A plan made ready to run: outputs numbered, inputs tied to tables, modes grouped by items."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from types import SimpleNamespace

from amberbox.core.mode import Input
from amberbox.monitoring.engine.evaluation import MappingRun, OutputRun
from amberbox.monitoring.engine.perinput import for_all
from amberbox.monitoring.engine.tables import Tables
from amberbox.monitoring.plan import MappingPlan, ModePlan, Plan


@dataclass(slots=True)
class Group:
    """Runs that read the same items: they are looked at at the same instants."""

    items: tuple[str, ...]
    runs: list[MappingRun] = field(default_factory=list)

    def forget(self) -> None:
        """Begin anew."""
        for run in self.runs:
            run.forget()
            for output in run.outputs:
                output.forget()


def build_groups(plan: Plan, tables: Tables) -> tuple[list[Group], list[OutputRun]]:
    """Make runs of all modes that can run; outputs are numbered in the order of the plan."""
    groups: dict[tuple[str, ...], Group] = {}
    outputs: list[OutputRun] = []
    for _, mode in plan.modes():
        for mapping in mode.mappings:
            own = [
                OutputRun(len(outputs) + place, output)
                for place, output in enumerate(mapping.outputs)
            ]
            outputs += own
            if not mode.problem:
                for run, items in _runs(mode, mapping, own, tables):
                    groups.setdefault(items, Group(items)).runs.append(run)
    return list(groups.values()), outputs


def _runs(
    mode: ModePlan, mapping: MappingPlan, outputs: Sequence[OutputRun], tables: Tables
) -> list[tuple[MappingRun, tuple[str, ...]]]:
    """Make one run of a mapping, or several where a mode is called for each input alone."""
    if not getattr(mode.module, "PER_INPUT", False):
        return [_run(mode, mapping, outputs, tables)]
    runs = []
    for place, entry in enumerate(mapping.inputs):
        own = [output for output in outputs if output.plan.place == place]
        if own:
            runs.append(_run(mode, replace(mapping, inputs=[entry]), own, tables))
    joined = [output for output in outputs if output.plan.place is None]
    if joined:
        whole = mode if len(mapping.inputs) == 1 else _of_all(mode, joined)
        runs.append(_run(whole, mapping, joined, tables))
    return runs


def _of_all(mode: ModePlan, outputs: Sequence[OutputRun]) -> ModePlan:
    """Return the mode as one of all inputs together."""
    module = SimpleNamespace(**vars(mode.module))
    results = [output.plan.result for output in outputs]
    module.evaluate = for_all(module.evaluate, results)
    module.explain = None
    return replace(mode, module=module)  # type: ignore[arg-type]  # a namespace does for a module


def _run(
    mode: ModePlan, mapping: MappingPlan, outputs: Sequence[OutputRun], tables: Tables
) -> tuple[MappingRun, tuple[str, ...]]:
    history = getattr(mode.module, "history_s", None)
    history_s = float(history(mode.config)) if history is not None else 0.0
    parts = bool(getattr(mode.module, "PARTS", False))
    plans = [*mapping.inputs, *mapping.reads]
    inputs: list[Input] = [tables.input(entry, history_s, parts) for entry in plans]
    items = tuple(sorted({entry.item for entry in plans}))
    return MappingRun(mode, mapping, inputs, outputs), items
