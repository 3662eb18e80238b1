"""Static files of the pages: styles, icons, and all browser modules joined into one file."""

from __future__ import annotations

import gzip
import hashlib
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import lru_cache
from importlib.resources import files
from pathlib import Path
from posixpath import dirname, join, normpath

from fastapi import HTTPException, Request, Response

from amberbox.experiments.drawing import RULES
from amberbox.server.http.auth import Open, Routes

_PATH = r'"(\.{1,2}/[\w/-]+\.js)";'
_FROM = r"\s+from\s+" + _PATH
_NAMED = re.compile(r"^import\s*\{([^}]*)\}" + _FROM, re.MULTILINE)
_WHOLE = re.compile(r"^import\s*\*\s*as\s+(\w+)" + _FROM, re.MULTILINE)
_ONLY = re.compile(r"^import\s+" + _PATH, re.MULTILINE)
_PASSED = re.compile(r"^export\s*\{([^}]*)\}" + _FROM, re.MULTILINE)
_EXPORT = re.compile(r"^export\s+((?:async\s+)?function\*?|const|let|class)\s+(\w+)", re.MULTILINE)
_LEFT = re.compile(r"^(?:import|export)\b(?!\s*[.(]).*", re.MULTILINE)
_HEAD = """const $made = {};
const $tell = ($out, names) => {
  for (const [name, get] of Object.entries(names)) Object.defineProperty($out, name, { get });
};
export function $need(name) {
  if (!$made[name]) $modules[name](($made[name] = {}));
  return $made[name];
}
const $modules = {
"""
_TAIL = """};
for (const { dataset } of document.querySelectorAll("template[data-module]")) {
  $need(`${dataset.module}.js`);
}
"""


def joined(modules: Mapping[str, str]) -> str:
    """Return the file ``all.js`` with all modules, given by name.

    Raises ValueError for an import or export in a form that is not supported.
    """
    parts = [_function(name, text) for name, text in modules.items()]
    return _HEAD + "".join(parts) + _TAIL


def _function(name: str, text: str) -> str:
    exports = _exports(name, text)
    body = _NAMED.sub(lambda m: f"const {{{_renamed(m[1])}}} = $need({_at(name, m[2])!r});", text)
    body = _WHOLE.sub(lambda m: f"const {m[1]} = $need({_at(name, m[2])!r});", body)
    body = _ONLY.sub(lambda m: f"$need({_at(name, m[1])!r});", body)
    body = _PASSED.sub("", body)
    body = _EXPORT.sub(r"\1 \2", body)
    left = _LEFT.search(body)
    if left is not None:
        raise ValueError(f"{name}: this cannot be joined: {left[0]}")
    getters = ", ".join(f"{key}: () => {value}" for key, value in exports.items())
    return f"{name!r}($out) {{ $tell($out, {{ {getters} }});\n{body}\n}},\n"


def _exports(name: str, text: str) -> dict[str, str]:
    """Return the exports of a module: the name, and the JavaScript expression of its value."""
    found = {export: export for _, export in _EXPORT.findall(text)}
    for names, module in _PASSED.findall(text):
        for inner, outer in _pairs(names):
            found[outer] = f"$need({_at(name, module)!r}).{inner}"
    return found


def _at(name: str, path: str) -> str:
    """Return the name of a module from a path relative to another one."""
    return normpath(join(dirname(name), path))


def _renamed(names: str) -> str:
    pairs = _pairs(names)
    return ", ".join(inner if inner == outer else f"{inner}: {outer}" for inner, outer in pairs)


def _pairs(names: str) -> list[tuple[str, str]]:
    """Return the exported and the local name of each part of ``a, b as c``."""
    words = [one.split(" as ") for one in names.replace("\n", " ").split(",") if one.strip()]
    return [(one[0].strip(), one[-1].strip()) for one in words]


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
    """A static file; ``packed`` is its gzip form."""

    data: bytes
    packed: bytes
    media_type: str


@lru_cache
def assets() -> Mapping[str, Asset]:
    """Return all assets by their path."""
    return {
        path: Asset(data, gzip.compress(data, 6, mtime=0), _TYPES[Path(path).suffix])
        for path, data in _contents()
    }


@lru_cache
def version() -> str:
    """Return the hash over all assets."""
    whole = hashlib.sha256()
    for path, asset in sorted(assets().items()):
        whole.update(path.encode() + b"\0" + asset.data + b"\0")
    return whole.hexdigest()[:16]


def address(path: str) -> str:
    """Return the URL path of an asset; raises KeyError for an unknown one."""
    assets()[path]
    return f"/static/{version()}/{path}"


def uplot(name: str) -> bytes:
    """Return a file of uPlot from the installed package."""
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
    """Yield all style sheets in the order in which they are joined."""
    folder = FOLDER / "css"
    rest = sorted(file.name for file in folder.glob("*.css") if file.name not in _FIRST)
    yield from ((folder / name).read_bytes() for name in _FIRST)
    yield uplot("uplot.min.css")
    yield from ((folder / name).read_bytes() for name in rest)
    yield RULES.encode()  # of diagrams, which are the same on pages and in files


routes = Routes(prefix="")

_FOR_EVER = "public, max-age=31536000, immutable"


@routes.get(
    "/static/{digest}/{path:path}",
    Open("how pages look and what runs in them: the same for everybody"),
    include_in_schema=False,
)
def read_asset(request: Request, digest: str, path: str) -> Response:
    """Return an asset; for a digest of another version the present file, not to be cached."""
    found = assets().get(path)
    if found is None:
        raise HTTPException(404, "there is no such file")
    headers = {"Cache-Control": _FOR_EVER if digest == version() else "no-cache",
               "Vary": "Accept-Encoding"}  # fmt: skip
    packs = "gzip" in request.headers.get("accept-encoding", "")
    if packs:
        headers["Content-Encoding"] = "gzip"
    return Response(found.packed if packs else found.data, headers=headers,
                    media_type=found.media_type)  # fmt: skip
