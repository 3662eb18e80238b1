"""Which versions run, and what is not possible because a package is missing."""

from __future__ import annotations

import importlib.util
import platform
from collections.abc import Callable, Iterator
from importlib.metadata import PackageNotFoundError, version

from amberbox import __version__
from amberbox.blackbox.doctor.finding import Finding, ok, warn
from amberbox.blackbox.doctor.host import Host
from amberbox.blackbox.doctor.subject import Subject

OPTIONAL = {
    "cryptography": ("keep", "what is recorded is not signed"),
    "pyarrow": ("keep", "no segments are built: queries read journals, slower; no Parquet"),
    "duckdb": ("query", "no SQL"),
    "tsdownsample": ("query", "plots of long ranges are slower"),
    "matplotlib": ("plot", "no plots as images"),
}
"""Packages by name, with the extra that brings them and what is missing without."""
_NEEDED = ("cryptography", "pyarrow")

_Find = Callable[[str], object]


def versions(subject: Subject, host: Host) -> Iterator[Finding]:
    """Name the versions; nothing is imported for it."""
    yield ok("versions", _text())
    yield from judged_packages(importlib.util.find_spec)


def judged_packages(find: _Find) -> Iterator[Finding]:
    """Judge which optional packages ``find`` does not find."""
    missing = [name for name in OPTIONAL if find(name) is None]
    if not missing:
        return
    found = "; ".join(f"without {name}: {OPTIONAL[name][1]}" for name in missing)
    extras = ",".join(sorted({OPTIONAL[name][0] for name in missing}))
    hint = f"pip install 'amberbox[{extras}]'"
    needed = any(name in _NEEDED for name in missing)
    yield (warn if needed else ok)("packages", found, hint)


def _text() -> str:
    packages = [f"{name} {_version(name)}" for name in ("numpy", *_NEEDED) if _version(name)]
    python = f"Python {platform.python_version()} ({platform.machine()})"
    return ", ".join((f"amberbox {__version__}", python, *packages))


def _version(name: str) -> str:
    try:
        return version(name)
    except PackageNotFoundError:
        return ""
