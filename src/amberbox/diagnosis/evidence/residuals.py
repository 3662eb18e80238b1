"""Evidence of residuals: a violated one proves that a component of its equations is faulty."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from amberbox.core.contracts import Conflict, EvidenceItem, EvidenceNeeds, EvidenceWindow
from amberbox.core.equations.generator import ResidualGenerator, generator_of
from amberbox.core.equations.model_file import load_model
from amberbox.core.errors import AmberboxError
from amberbox.diagnosis.covering.model import UNKNOWN
from amberbox.diagnosis.knowledge import Knowledge
from amberbox.diagnosis.models import models_of

SOURCE = "residuals"


def needs(knowledge: Knowledge, folder: Path) -> EvidenceNeeds | None:
    """Return that it needs the symptoms, if an output of a monitor shows a residual."""
    return EvidenceNeeds() if any(shown_residuals(folder)) else None


def provide(knowledge: Knowledge, window: EvidenceWindow) -> Iterator[EvidenceItem]:
    """Yield a conflict for each violated residual: the faults of its components, unknown included.

    None where a component is not in the FMEA: then its fault may be one that cannot be named.
    """
    present = {s.id for s in window.symptoms if s.state == "present" and not s.blocked_by}
    for generator in shown_residuals(window.folder):
        if generator.options.shown_by in present:
            faults = _faults(knowledge, generator)
            if faults:
                yield Conflict(faults, SOURCE, f"{generator.checks} does not hold")


def shown_residuals(folder: Path) -> Iterator[ResidualGenerator]:
    """Yield the residuals of a folder's models that an output shows; those with mistakes are left
    out, as ``check`` and their monitors name them.
    """
    for path in models_of(folder)["equations"].values():
        try:
            model = load_model(path)
        except AmberboxError:
            continue
        for name, options in model.residuals.items():
            try:
                if options.shown_by:
                    yield generator_of(model, name)
            except AmberboxError:
                continue


def _faults(knowledge: Knowledge, generator: ResidualGenerator) -> frozenset[str]:
    modes = knowledge.model.modes
    if not set(generator.components) <= {mode.component for mode in modes}:
        return frozenset()
    found = {mode.id for mode in modes if mode.component in generator.components}
    unknown = {UNKNOWN} & knowledge.model.mode_places.keys()
    return frozenset(found | unknown) if found else frozenset()
