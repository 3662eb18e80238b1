"""Evidence from models of components: conflicts between what is observed and sound components."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from functools import lru_cache
from pathlib import Path

from amberbox.core.contracts import Conflict, EvidenceItem, EvidenceNeeds, EvidenceWindow, Finding
from amberbox.core.types import UNKNOWN_FAULT
from amberbox.diagnosis.consistency.components import Components, load_components
from amberbox.diagnosis.consistency.online import (
    conflicts_of,
    history_s,
    mapped,
    observed_steps,
    possible_faults,
    seen_text,
)
from amberbox.diagnosis.knowledge import Knowledge
from amberbox.diagnosis.models import models_of

SOURCE = "consistency"


def needs(knowledge: Knowledge, folder: Path) -> EvidenceNeeds | None:
    """Return how far back the models with ``observe:`` read the record; None without any.

    Raises ConfigurationError for a model that cannot be read.
    """
    models = bound_models(folder, knowledge.config_hash)
    if not models:
        return None
    return EvidenceNeeds(max(map(history_s, models.values())), reads_symptoms=False)


def provide(knowledge: Knowledge, window: EvidenceWindow) -> Iterator[EvidenceItem]:
    """Yield the conflicts of each model at the instant, as sets of failure modes."""
    models = bound_models(window.folder, knowledge.config_hash)
    failure_modes = [*knowledge.fmea.modes, UNKNOWN_FAULT]
    for name, model in models.items():
        past = window.past(EvidenceNeeds(history_s=history_s(model)))
        if past is None:
            continue
        observed = observed_steps(model, past, window.at_ns)
        if observed.is_empty:
            continue
        conflicts, incomplete = conflicts_of(model, observed.steps)
        shown = ", ".join(seen_text(observed.steps[-1]))
        named = {name for conflict in conflicts for name in conflict}
        possible = possible_faults(model, observed.steps, named)
        for conflict in conflicts:
            left = [fault for fault in possible if model.faults[fault][0] in conflict]
            text = f"{name}: not all are sound: {', '.join(conflict) or 'the model is wrong'}"
            faults, unmapped = mapped(model, left, failure_modes)
            if faults and not unmapped:
                yield Conflict(faults, SOURCE, f"{text} (observed: {shown})")
            else:
                why = f"; no failure mode stands for {', '.join(unmapped)}" if unmapped else ""
                yield Finding(f"{text}{why}", SOURCE)
        if incomplete:
            yield Finding(f"{name}: not all conflicts were found: {incomplete}", SOURCE)


def bound_models(folder: Path, config_hash: str = "") -> Mapping[str, Components]:
    """Return the models of components in a folder that read its record, by name.

    Raises ConfigurationError for one that cannot be read.
    """
    return _read_once(folder, config_hash) if config_hash else _read(folder)


@lru_cache(maxsize=4)
def _read_once(folder: Path, config_hash: str) -> Mapping[str, Components]:
    return _read(folder)


def _read(folder: Path) -> Mapping[str, Components]:
    files = models_of(folder)["components"]
    models = {name: load_components(path) for name, path in files.items()}
    return {name: model for name, model in models.items() if model.observe}
