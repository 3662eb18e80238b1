"""Constants of a message as labels of the integer fields they were written for."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from amberbox.blackbox.unroll.definition import Structure


def field_labels(structure: Structure) -> Mapping[str, Mapping[int, str]]:
    """Say which constants name the values of which fields.

    A constant belongs to the fields of its own type whose name it starts with (``STATUS_FIX`` to
    ``status``, the longest such name wins). A field that is the only one of its type and has no
    such constants takes all constants of the type.
    """
    labels: dict[str, dict[int, str]] = {}
    for kind in {kind for kind, _, _ in structure.constants}:
        constants = _integers(structure, kind)
        fields = [name for name, field in structure.fields if field.base == kind]
        claimed = _claimed(constants, fields)
        if not claimed and len(fields) == 1 and constants:
            claimed = {fields[0]: _by_value(constants)}
        labels.update(claimed)
    return labels


def _integers(structure: Structure, kind: str) -> list[tuple[str, int]]:
    return [
        (label, value)
        for constant_kind, label, value in structure.constants
        if constant_kind == kind and isinstance(value, int) and not isinstance(value, bool)
    ]


def _claimed(
    constants: Sequence[tuple[str, int]], fields: Sequence[str]
) -> dict[str, dict[int, str]]:
    shares: dict[str, list[tuple[str, int]]] = {}
    for label, value in constants:
        owners = [name for name in fields if label.upper().startswith(f"{name.upper()}_")]
        if owners:
            shares.setdefault(max(owners, key=len), []).append((label, value))
    return {name: _by_value(share) for name, share in shares.items()}


def _by_value(constants: Sequence[tuple[str, int]]) -> dict[int, str]:
    """Map values to labels; of several labels for one value the first stays."""
    return {value: label for label, value in reversed(constants)}
