"""Text in CSV that a spreadsheet must not run: robots say it, or somebody on their network."""

from __future__ import annotations

_FORMULA = tuple("=+-@\t\r\n|%＝＋－＠")  # noqa: RUF001 -- full-width signs start formulas, too


def harmless(text: str) -> str:
    """Put ``'`` before a text that a spreadsheet would take for a formula or a command."""
    return f"'{text}" if text.lstrip(" ").startswith(_FORMULA) else text
