"""Modules of the pages in one file: each runs once, when it is needed, with its exports."""

from __future__ import annotations

import re

import pytest

from amberbox.server.web import assets
from amberbox.server.web.assets import joined


def test_imports_and_exports_become_functions() -> None:
    modules = {
        "a.js": 'import { b, c as d } from "./b.js";\nimport * as all from "./b.js";\n'
        'import "./b.js";\nexport function f() { return b + d + all.b; }\n'
        'export { b as again } from "./b.js";\n',
        "b.js": "export const b = 1;\nexport async function c() {}\n",
    }
    whole = joined(modules)
    assert "const {b, c: d} = $need('b.js');" in whole
    assert "const all = $need('b.js');" in whole
    assert "$tell($out, { f: () => f, again: () => $need('b.js').b });" in whole
    assert "\nasync function c() {}" in whole
    assert not re.search(r"^(import|export) (?!function \$need)", whole, re.MULTILINE)


@pytest.mark.parametrize(
    "text", ["export default 1;", 'import x from "./b.js";', "export { x };", "export * from 'x';"]
)
def test_what_cannot_be_joined_is_refused(text: str) -> None:
    with pytest.raises(ValueError, match=r"a\.js: this cannot be joined"):
        joined({"a.js": text})


def test_all_modules_of_the_pages_can_be_joined() -> None:
    folder = assets.FOLDER / "js"
    modules = {
        file.relative_to(folder).as_posix(): file.read_text("utf-8")
        for file in folder.rglob("*.js")
    }
    whole = joined(modules)
    for name in modules:
        assert whole.count(f"\n{name!r}($out) {{") == 1
    needed = set(re.findall(r"\$need\('([\w/-]+\.js)'\)", whole))
    assert needed <= set(modules)
