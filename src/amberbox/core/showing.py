"""Text of others as it may be shown: on pages, in terminals, in mails and logs.

Controls (C0, C1, terminal escapes), marks that reorder text, and characters that cannot be seen are
written out as ``\\u202e``, so that a text shows what is in it and does nothing else. That is also
how JSON writes them.
"""

from __future__ import annotations

import re

_HIDDEN = re.compile(
    "[\x00-\x08\x0b-\x1f\x7f-\x9f\xad\u061c\u180e\u200b\u200e\u200f\u2028-\u202e\u2060-\u206f"
    "\ufeff\ufff9-\ufffb\ud800-\udfff\U000e0000-\U000e007f]"
    "|(?<![^\x00-\x7f])[\u200c\u200d]"  # joiners belong to scripts and emoji: not behind ASCII
)


def visible(text: str) -> str:
    """Return a text in which nothing is hidden; line ends and tabs stay."""
    return text if text.isprintable() else _HIDDEN.sub(_written, text)


def one_line(text: str) -> str:
    """Return the same without line ends and tabs."""
    if text.isprintable():
        return text
    return visible("".join(" " if char.isspace() else char for char in text))


def _written(match: re.Match[str]) -> str:
    code = ord(match.group())
    if code < 0x10000:
        return f"\\u{code:04x}"
    high, low = divmod(code - 0x10000, 0x400)
    return f"\\u{0xD800 + high:04x}\\u{0xDC00 + low:04x}"
