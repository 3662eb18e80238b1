"""Answers name files as their robot does: where its folder stands here is nobody's matter."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from functools import wraps
from pathlib import Path
from typing import Any, TypeAlias

from amberbox.core.errors import AmberboxError, UsageError
from amberbox.fleet.folders.shelf import FOLDERS

Op: TypeAlias = Callable[[Path, dict[str, Any]], bytes]


def spoken(answer: Callable[[Path, dict[str, Any]], Any]) -> Op:
    """Make an operation of a function: answers as JSON, errors, both without our paths."""

    @wraps(answer)
    def op(folder: Path, arguments: dict[str, Any]) -> bytes:
        try:
            found = answer(folder, arguments)
        except AmberboxError as error:
            kind = UsageError if isinstance(error, UsageError) else AmberboxError
            what, hint = (without_paths(folder, text) for text in (error.what, error.hint))
            raise kind(what, hint) from error
        text = json.dumps(found, ensure_ascii=False, allow_nan=False)
        return without_paths(folder, text).encode("utf-8", "backslashreplace")

    return op


def without_paths(folder: Path, text: str) -> str:
    """Return a text in which files of robots' folders are named as their robots name them."""
    places = {re.escape(str(place)) for place in (folder, folder.absolute(), folder.resolve())}
    start = "|".join(sorted(places, key=len, reverse=True))
    return re.sub(rf"(?:{start})/{FOLDERS}/[a-z0-9_.-]+/[0-9a-f]{{64}}/?", "", text)
