"""The form of the secrets that a server makes: a mark that says what for, an id, random letters.

Robots know it as well: to see that a pasted key is whole, and to mask keys in what they send.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Literal

Kind = Literal["session", "token", "robot"]

MARKS: Mapping[Kind, str] = {"session": "abs", "token": "abt", "robot": "abr"}
LOOKS_LIKE_ONE = re.compile(r"ab[str]_[0-9a-f]{12}_[A-Za-z0-9_-]{20,}")
"""Finds them within a text, also those that are cut off: to be masked."""

_FORM = re.compile(r"(ab[str])_([0-9a-f]{12})_([A-Za-z0-9_-]{43})")


def is_secret(text: str, kind: Kind) -> bool:
    """Tell whether a text has the form of such a secret; all others need no look-up."""
    found = _FORM.fullmatch(text)
    return found is not None and found[1] == MARKS[kind]
