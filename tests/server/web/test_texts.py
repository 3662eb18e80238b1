"""The catalogue holds all texts of pages, and no unused ones."""

import re
from collections.abc import Iterator

from amberbox.server.web.page import TEMPLATES
from amberbox.server.web.text import catalogue

PAGES = TEMPLATES.parent
NAMED = re.compile(r"""["'`]([a-z][\w-]*(?:\.[\w-]+)+)["'`]""")
"""A name of a text that occurs literally in a source."""
BEGUN = re.compile(r"""["'`]([a-z][\w-]*\.[\w.-]*)(?:["'] ~|\$?\{)""")
"""A name whose end is worked out: ``"alarms.tabs." ~ tab``, ``f"error.hint.{name}"``."""
WHOLE = ("words.", "robot.time.windows.")
"""Every word is on the page of help; chips are composed of two names."""
WRITES = re.compile(
    r"""\.textContent\s*=[^=]|\.title\s*=[^=]|\.innerText\b|\.innerHTML\b|insertAdjacent|\.ariaLabel\b"""
    r"""|setAttribute\(\s*["'](?:title|alt|placeholder|label|aria-label|aria-description|data-label)["']"""
    r"""|fillText\((?!escapeHidden\()|strokeText\("""
)
"""Ways to write a text past ``escapeHidden``, which writes out what a text hides."""
ONE_OR_MANY = ("alarms.acknowledged_one", "alarms.not_acknowledged_one")
"""Names that modules put together from two ends."""


def sources() -> Iterator[str]:
    for pattern in ("**/*.py", "templates/**/*.html", "static/js/**/*.js"):
        for path in sorted(PAGES.glob(pattern)):
            yield path.read_text(encoding="utf-8")


def asked(name: str) -> str:
    """Return how sources ask for a text: in the browser without ``js``."""
    return name.replace(".js.", ".", 1)


def test_every_text_is_used() -> None:
    code = "\n".join(sources())
    named, heads = set(NAMED.findall(code)), tuple(set(BEGUN.findall(code)))
    unused = {
        name for name in catalogue().texts
        if not {name, asked(name)} & {*named, *ONE_OR_MANY}
        and not name.startswith((*heads, *WHOLE)) and not asked(name).startswith(heads)
    }  # fmt: skip
    assert unused == set()


def test_no_module_writes_texts_past_the_function_that_writes_out_what_they_hide() -> None:
    found = [
        f"{path.name}: {line.strip()}"
        for path in sorted(PAGES.glob("static/js/**/*.js"))
        for line in path.read_text(encoding="utf-8").splitlines()
        if path.name != "dom.js" and WRITES.search(line) and "document.title" not in line
    ]
    assert found == []
