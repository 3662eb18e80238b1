"""All modules of the pages in one file, ``all.js``: a page asks for that and not for sixty files.

Each module becomes a function that runs when it is first needed, and once; what it exports is told
by functions, so that modules may need each other. A page names the modules that it starts with in
``data-module`` of its templates. Nothing else is changed: in the browser's tools they read as here.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from posixpath import dirname, join, normpath

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
    """Return ``all.js`` of modules by name.

    Raises ValueError for a module that imports or exports in another form than the pages do.
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
    told = ", ".join(f"{key}: () => {value}" for key, value in exports.items())
    return f"{name!r}($out) {{ $tell($out, {{ {told} }});\n{body}\n}},\n"


def _exports(name: str, text: str) -> dict[str, str]:
    """Return what a module exports: the name, and the expression that has its value."""
    found = {export: export for _, export in _EXPORT.findall(text)}
    for names, module in _PASSED.findall(text):
        for inner, outer in _pairs(names):
            found[outer] = f"$need({_at(name, module)!r}).{inner}"
    return found


def _at(name: str, path: str) -> str:
    """Return the name of what a module imports by a path that begins beside it."""
    return normpath(join(dirname(name), path))


def _renamed(names: str) -> str:
    pairs = _pairs(names)
    return ", ".join(inner if inner == outer else f"{inner}: {outer}" for inner, outer in pairs)


def _pairs(names: str) -> list[tuple[str, str]]:
    """Read ``a, b as c``: the name there and the name here of each."""
    words = [one.split(" as ") for one in names.replace("\n", " ").split(",") if one.strip()]
    return [(one[0].strip(), one[-1].strip()) for one in words]
