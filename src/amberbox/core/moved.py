"""Old import paths of documented modules, so that programs and plugins that use them still work.

``amberbox`` puts ``Moved`` at the end of the import system: it is called only for modules that do
not exist. A module that moved is then an alias whose names are looked up in its new places.
"""

from __future__ import annotations

import importlib
import importlib.util
from collections.abc import Mapping, Sequence
from importlib.abc import InspectLoader, MetaPathFinder
from importlib.machinery import ModuleSpec
from types import CodeType, ModuleType
from typing import Any

# old module: where its names are; ``python -m`` starts the first of them
MOVED: Mapping[str, Sequence[str]] = {
    "blackbox.exporting": ("blackbox.query.export", "blackbox.query.export_job"),
    "blackbox.formats.options": ("blackbox.formats._recording",),
    "blackbox.importing": ("blackbox.query.importing",),
    "blackbox.journal.reserved": ("blackbox.journal.channels",),
    "blackbox.missions.ask": ("blackbox.retention.missions",),
    "blackbox.query.open": ("blackbox.query.record",),
    "blackbox.retention.mission_requests": ("blackbox.retention.missions",),
    "blackbox.unroll": ("blackbox.columns.unroll",),
    "client.alarm_models": ("client.models",),
    "client.data_models": ("client.models",),
    "client.times": ("client.models",),
    "diagnosis.answering": ("diagnosis.diagnose",),
    "diagnosis.covering.answer": ("diagnosis.covering.hypotheses",),
    "diagnosis.covering.evidence": ("diagnosis.covering.observations",),
    "diagnosis.explanation": (
        "diagnosis.report.explain", "diagnosis.report.svg", "diagnosis.report.text",
    ),
    "diagnosis.faulttree.formula": ("diagnosis.faulttree.tree",),
    "diagnosis.faulttree.closest_cut_sets": ("diagnosis.faulttree.analysis",),
    "diagnosis.faulttree.nearest": ("diagnosis.faulttree.analysis",),
    "diagnosis.findings.facts": ("diagnosis.evidence.rules",),
    "diagnosis.findings.rules": ("diagnosis.evidence.rules",),
    "diagnosis.fmea.compile": ("diagnosis.knowledge",),
    "diagnosis.fmea.load": ("diagnosis.fmea.loader",),
    "diagnosis.fmea.propagation": ("diagnosis.fmea.model",),
    "diagnosis.fmea.trees": ("diagnosis.fmea.fault_trees",),
    "diagnosis.rules": (
        "diagnosis.prolog.machine", "diagnosis.prolog.program", "diagnosis.prolog.query",
    ),
    "diagnosis.rules.faults": ("diagnosis.prolog.terms",),
    "fleet.archive.record": ("server.archive.record",),
    "fleet.archive.worker": ("server.archive.worker",),
    "fleet.asking.worker": ("server.workers.process",),
    "fleet.system.child": ("server.systemchild",),
    "testing.proxy": ("testing.fault_proxy",),
}  # fmt: skip

_OURS = "amberbox."
_PACKAGES = frozenset(name[:at] for name in MOVED for at, sign in enumerate(name) if sign == ".")


class Moved(MetaPathFinder, InspectLoader):
    """Finds modules by their old paths."""

    def find_spec(
        self, fullname: str, path: Sequence[str] | None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        """Return the spec of an alias; None for a name that was never a documented module."""
        name = fullname.removeprefix(_OURS)
        if name == fullname or name not in MOVED.keys() | _PACKAGES:
            return None
        return ModuleSpec(fullname, self, is_package=name in _PACKAGES)

    def create_module(self, spec: ModuleSpec) -> ModuleType:
        """Make the alias."""
        return _Alias(spec.name)

    def exec_module(self, module: ModuleType) -> None:
        """Do nothing: names are looked up when they are used."""

    def get_code(self, fullname: str) -> CodeType | None:
        """Return the program that ``python -m`` starts."""
        spec = importlib.util.find_spec(_OURS + MOVED[fullname.removeprefix(_OURS)][0])
        assert spec is not None and isinstance(spec.loader, InspectLoader)
        return spec.loader.get_code(spec.name)

    def get_source(self, fullname: str) -> str | None:
        """Return nothing: tracebacks show the new file."""
        return None


class _Alias(ModuleType):
    def __getattr__(self, name: str) -> Any:
        for place in MOVED.get(self.__name__.removeprefix(_OURS), ()):
            found = getattr(importlib.import_module(_OURS + place), name, self)
            if found is not self:
                return found
        raise AttributeError(f"module {self.__name__!r} has no attribute {name!r}")
