"""Which function a mode file means: ``monitor:``, or what its name says."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from types import ModuleType

from amberbox.core import plugins
from amberbox.core.config import did_you_mean
from amberbox.core.errors import AmberboxError

MODES = "amberbox.monitoring.modes"
PROBES = "amberbox.monitoring.probes"
OWN_MODES = "modes"
"""Folder of a robot folder with monitors of its own, one file each."""
OWN_PROBES = "probes"
MODE_DEFINES = ("Config", "evaluate")
PROBE_DEFINES = ("MEASURES", "SUBJECT", "measure")
_ENDINGS = ("_monitor", "_functional")
_NEEDED = ("Config", "ACCEPTS", "RESULTS", "evaluate")


@dataclass(frozen=True)
class Functions:
    """The monitors and probes that are there."""

    modes: Mapping[str, plugins.Plugin]
    probes: Collection[str]

    def load(self, name: str) -> ModuleType:
        """Import a monitor; raise AmberboxError if it cannot be, or does not keep the contract."""
        try:
            module = self.modes[name].load()
        except AmberboxError:
            raise
        except (Exception, SystemExit) as error:  # a robot's own monitor may fail in any way
            what = f"monitor '{name}' cannot be loaded: {type(error).__name__}: {error}"
            raise AmberboxError(what, f"look at {self.modes[name].path}") from error
        missing = [word for word in _NEEDED if not hasattr(module, word)]
        if missing:
            what = f"monitor '{name}' does not define {', '.join(missing)}"
            raise AmberboxError(what, f"look at {self.modes[name].path}")
        return module


def find_functions(folder: Path, *, own: bool = True) -> Functions:
    """Find the monitors and probes: those that come with Amberbox, then the folder's own.

    Without ``own``, Python of the folder is not even looked at.
    """
    if not own:
        modes, probes = _shipped(MODES, MODE_DEFINES), _shipped(PROBES, PROBE_DEFINES)
        return Functions(modes, frozenset(probes))
    modes = _found(MODES, folder / OWN_MODES, MODE_DEFINES)
    probes = _found(PROBES, folder / OWN_PROBES, PROBE_DEFINES)
    return Functions(modes, frozenset(probes))


def _found(package: str, own: Path, defines: tuple[str, ...]) -> Mapping[str, plugins.Plugin]:
    return plugins.find(package, [own], defines) if own.is_dir() else _shipped(package, defines)


@lru_cache
def _shipped(package: str, defines: tuple[str, ...]) -> Mapping[str, plugins.Plugin]:
    """Find what does not change while the program runs; its files are read once."""
    return plugins.find(package, (), defines)


def short_name(name: str) -> str:
    """Return the name of a mode without ``_monitor`` and ``_functional``."""
    for ending in _ENDINGS:
        name = name.removesuffix(ending)
    return name


def function_of(name: str, known: Collection[str]) -> str | None:
    """Return the function that a mode's name means: its whole, else its longest known ending."""
    words = short_name(name).split("_")
    endings = ("_".join(words[start:]) for start in range(len(words)))
    return next((ending for ending in endings if ending in known), None)


def unknown_function(name: str, known: Sequence[str], *, is_key: bool) -> str:
    """Say that there is no such function."""
    if is_key:
        return f"there is no monitor '{name}'{did_you_mean(name, known)}"
    near = did_you_mean(short_name(name).rpartition("_")[2], known)
    return f"no monitor goes by the name '{name}'{near}"
