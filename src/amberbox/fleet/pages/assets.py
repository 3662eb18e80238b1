"""What browsers load beside pages: styles, modules, icons, and uPlot from its package.

All of it lies in memory, packed, below an address that names what it is: it changes with any byte,
so browsers need never ask again.
"""

from __future__ import annotations

import gzip
import hashlib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import lru_cache
from importlib.resources import files
from pathlib import Path

from amberbox.fleet.pages.joining import joined

FOLDER = Path(__file__).parent / "static"
PLOT = "vendor/uplot.js"
"""uPlot, https://github.com/leeoniya/uPlot, MIT: as the package ``youplot`` carries it."""
STYLE = "site.css"
MODULES = "all.js"
_FIRST = ("tokens.css", "base.css")
_TYPES = {".js": "text/javascript; charset=utf-8", ".css": "text/css; charset=utf-8",
          ".svg": "image/svg+xml"}  # fmt: skip


@dataclass(frozen=True, slots=True)
class Asset:
    """A file for browsers; ``packed`` is by gzip."""

    data: bytes
    packed: bytes
    media_type: str


@lru_cache
def assets() -> Mapping[str, Asset]:
    """Return everything by its path below the address."""
    return {path: _asset(path, data) for path, data in _contents()}


@lru_cache
def version() -> str:
    """Return the hash of everything there is."""
    whole = hashlib.sha256()
    for path, asset in sorted(assets().items()):
        whole.update(path.encode() + b"\0" + asset.data + b"\0")
    return whole.hexdigest()[:16]


def address(path: str) -> str:
    """Return where the browser finds an asset; raises KeyError if there is none."""
    assets()[path]
    return f"/static/{version()}/{path}"


def uplot(name: str) -> bytes:
    """Return a file of uPlot out of the installed package."""
    return (files("youplot") / "vendor" / name).read_bytes()


def _contents() -> Iterator[tuple[str, bytes]]:
    yield STYLE, b"\n".join(_styles())
    yield PLOT, uplot("uplot.iife.min.js")
    yield "icons.svg", (FOLDER / "icons.svg").read_bytes()
    folder = FOLDER / "js"
    found = sorted(folder.rglob("*.js"))
    modules = {file.relative_to(folder).as_posix(): file.read_text("utf-8") for file in found}
    yield MODULES, joined(modules).encode()


def _styles() -> Iterator[bytes]:
    """Return all styles in order: one file is one request."""
    folder = FOLDER / "css"
    rest = sorted(file.name for file in folder.glob("*.css") if file.name not in _FIRST)
    yield from ((folder / name).read_bytes() for name in _FIRST)
    yield uplot("uplot.min.css")
    yield from ((folder / name).read_bytes() for name in rest)


def _asset(path: str, data: bytes) -> Asset:
    return Asset(data, gzip.compress(data, 6, mtime=0), _TYPES[Path(path).suffix])
