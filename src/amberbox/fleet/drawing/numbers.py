"""Numbers as people read them."""

from __future__ import annotations

_RAISED = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")


def chance(probability: float | None) -> str:
    """Write a probability with two digits: ``0.013``, ``5.8·10⁻⁶``; empty if nobody knows it."""
    if probability is None:
        return ""
    if probability >= 0.001 or not probability:
        return f"{probability:.2g}"
    digits, power = f"{probability:.1e}".split("e")
    return f"{digits}·10{str(int(power)).translate(_RAISED)}"
