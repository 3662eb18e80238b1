"""Relations: sets of rows with an index for every combination of columns that is asked for."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from typing import Any, TypeAlias

from amberbox.diagnosis.rules.datalog.forms import Row

Columns: TypeAlias = tuple[int, ...]
Index: TypeAlias = Mapping[Any, Collection[Row]]


class Relation:
    """Rows in the order in which they were added, each with where it comes from."""

    def __init__(self) -> None:
        self.rows: dict[Row, Any] = {}
        self._order: list[Row] = []
        self._indexes: dict[Columns, dict[Any, list[Row]]] = {}

    def add(self, row: Row, origin: Any) -> bool:
        """Add a row; False if it was there."""
        if row in self.rows:
            return False
        self.rows[row] = origin
        self._order.append(row)
        for columns, index in self._indexes.items():
            index.setdefault(_key(row, columns), []).append(row)
        return True

    def index(self, columns: Columns) -> Index:
        """Return the rows by the values of some columns; by ``()`` for no columns.

        The value of one column is the key itself, those of several a tuple.
        """
        if not columns:
            return {(): self._order}
        found = self._indexes.get(columns)
        if found is None:
            found = self._indexes[columns] = {}
            for row in self._order:
                found.setdefault(_key(row, columns), []).append(row)
        return found

    def per_key(self, columns: Columns) -> float:
        """Return how many rows there are on average for given values of some columns."""
        return len(self._order) / max(1, len(self.index(columns)))


def _key(row: Row, columns: Columns) -> Any:
    return row[columns[0]] if len(columns) == 1 else tuple(row[column] for column in columns)
