"""Values of parameters in the texts of a declaration: ``"{name}"`` stands for a whole value.

Nothing is ever put into the middle of a text, so that a value cannot become syntax of whatever
reads the text: it stays one JSON value, or one argument of a program.
"""

from __future__ import annotations

import re
from collections.abc import Collection, Iterator, Mapping
from typing import Any

from amberbox.core.errors import did_you_mean

_WHOLE = re.compile(r"\{([A-Za-z_]\w*)\}")


def filled(template: Any, parameters: Mapping[str, Any]) -> Any:
    """Return a template of lists, mappings and texts with each ``"{name}"`` replaced by a value."""
    if isinstance(template, Mapping):
        return {key: filled(value, parameters) for key, value in template.items()}
    if isinstance(template, list | tuple):
        return [filled(value, parameters) for value in template]
    found = _WHOLE.fullmatch(template) if isinstance(template, str) else None
    return template if found is None else parameters[found[1]]


def problems(
    templates: Mapping[str, Any], parameters: Collection[str], *required: str
) -> Iterator[tuple[str, str]]:
    """Yield what is wrong with the placeholders of templates, by the key of each template.

    A parameter that is used by none of the templates ``required`` is wrong as well: its value would
    have no effect.
    """
    used: dict[str, set[str]] = {key: set() for key in templates}
    for key, template in templates.items():
        for text, is_name in _texts(template):
            whole = None if is_name else _WHOLE.fullmatch(text)
            if whole is not None and whole[1] in parameters:
                used[key].add(whole[1])
            elif whole is not None:
                near = did_you_mean(whole[1], parameters)
                yield key, f"there is no parameter '{whole[1]}'{near}"
            elif inner := _WHOLE.search(text):
                place = f"in the key '{text}'" if is_name else f"a part of '{text}'"
                yield key, f"'{inner[0]}' has to be a whole value, not {place}"
    effective = set().union(*(used[key] for key in required))
    for name in sorted(set(parameters) - effective):
        yield "parameters", f"'{name}' has no effect: nothing in {' or '.join(required)} uses it"


def _texts(template: Any) -> Iterator[tuple[str, bool]]:
    """Yield each text, and whether it is the key of a mapping."""
    if isinstance(template, str):
        yield template, False
    elif isinstance(template, Mapping):
        for key, value in template.items():
            yield key, True
            yield from _texts(value)
    elif isinstance(template, list | tuple):
        for value in template:
            yield from _texts(value)
