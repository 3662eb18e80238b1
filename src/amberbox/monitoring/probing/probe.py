"""A probe that is ready to look: loaded from its file, its answers checked."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeAlias

from amberbox.core import plugins
from amberbox.core.errors import AmberboxError
from amberbox.core.probe import PERIOD_S, TIMEOUT_S, Measured

PROBES = "amberbox.monitoring.probes"
DEFINES = ("MEASURES", "SUBJECT", "measure")

Row: TypeAlias = Mapping[str, Any]
"""``subject``, ``ok``, ``error``, and all that the probe measures; null is unknown."""

_TYPES: Mapping[str, Callable[[Any], Any]] = {
    "bool": bool,
    "int": int,
    "float": float,
    "string": str,
}


_WHOLE = 1 << 63
"""Whole numbers lie below this."""
_INFINITE = (math.inf, -math.inf)


class ProbeDefectError(Exception):
    """A probe gave what its contract does not allow."""


@dataclass(frozen=True, slots=True)
class Probe:
    """What a probe's file defines; see ``core.probe``."""

    kind: str
    measure: Callable[[str], Measured]
    measures: Mapping[str, tuple[str, str, str]] = field(default_factory=dict)
    period_s: float = PERIOD_S
    timeout_s: float = TIMEOUT_S

    def look(self, subject: str) -> Row:
        """Look once; whatever goes wrong stands in the row as its error."""
        try:
            return self._row(subject, self.measure(subject))
        except AmberboxError as error:
            return self.unknown(subject, error.what)
        except OSError as error:
            return self.unknown(subject, os_error_text(error))
        except (Exception, SystemExit) as error:  # a defect of the probe: its row says so
            return self.unknown(subject, f"crashed: {type(error).__name__}: {error}")

    def unknown(self, subject: str, error: str) -> Row:
        """Make the row of a look that found nothing out."""
        unknown = dict.fromkeys(self.measures)
        return {"subject": _readable(subject), "ok": None, "error": _readable(error), **unknown}

    def _row(self, subject: str, measured: Measured) -> Row:
        extra = sorted(set(measured) - set(self.measures) - {"ok", "error"})
        if extra:
            raise ProbeDefectError(f"it gives '{extra[0]}', which its MEASURES do not name")
        values = {
            name: _as_type(kind, measured.get(name)) for name, (kind, _, _) in self.measures.items()
        }
        ok, error = _as_type("bool", measured["ok"]), str(measured.get("error", ""))
        return {"subject": _readable(subject), "ok": ok, "error": _readable(error), **values}


def load_probe(kind: str, extra_dirs: Sequence[Path] = ()) -> Probe:
    """Load a probe by its kind; raise AmberboxError if there is none or it cannot be loaded."""
    plugin = plugins.get(PROBES, kind, extra_dirs, DEFINES)
    try:
        module = plugin.load()
    except AmberboxError:
        raise
    except (Exception, SystemExit) as error:  # a robot's own probe may fail in any way
        what = f"probe '{kind}' cannot be loaded: {type(error).__name__}: {error}"
        raise AmberboxError(what, f"look at {plugin.path}") from error
    period_s = float(getattr(module, "PERIOD_S", PERIOD_S))
    timeout_s = float(getattr(module, "TIMEOUT_S", TIMEOUT_S))
    return Probe(kind, module.measure, module.MEASURES, period_s, timeout_s)


def known_probes(extra_dirs: Sequence[Path] = ()) -> Mapping[str, plugins.Plugin]:
    """Find all probes, ours and those of a robot folder; none of them is imported."""
    return plugins.find(PROBES, extra_dirs, DEFINES)


def probes_for(kinds: Iterable[str], extra_dirs: Sequence[Path] = ()) -> Mapping[str, Probe]:
    """Load probes, each once; one that cannot be loaded says so with every look."""
    return {kind: _probe_for(kind, extra_dirs) for kind in sorted(set(kinds))}


def _probe_for(kind: str, extra_dirs: Sequence[Path]) -> Probe:
    try:
        return load_probe(kind, extra_dirs)
    except AmberboxError as error:
        return broken(kind, error)


def broken(kind: str, error: AmberboxError) -> Probe:
    """Return a probe that knows nothing but why."""

    def measure(subject: str) -> Measured:
        raise AmberboxError(error.what, error.hint)

    return Probe(kind, measure)


def os_error_text(error: OSError) -> str:
    """Say what the system refused, with the file it is about."""
    place = f"{error.filename}: " if error.filename else ""
    return f"{place}{error.strerror or error or type(error).__name__}"


def _as_type(kind: str, value: Any) -> Any:
    """Give every value the type that it was promised with, so that columns never change theirs.

    What JSON cannot hold is unknown, or shown as well as it can be.
    """
    if value is None or (kind != "string" and (value != value or value in _INFINITE)):
        return None
    made = _TYPES[kind](value)
    if kind == "string":
        return _readable(made)
    fits = math.isfinite(made) if kind == "float" else -_WHOLE <= made < _WHOLE
    return made if fits else None


def _readable(text: str) -> str:
    """Show bytes of the system that are no text as question marks."""
    return text.encode("utf-8", "replace").decode()
