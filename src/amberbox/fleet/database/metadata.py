"""What the tables of all rooms have in common: one catalogue of them, and their kinds of columns.

A room defines its tables in a module ``tables`` of its own, on ``METADATA``; ``complete`` finds
these modules by their name. Times are integer nanoseconds since the Unix epoch (``Time``).
"""

from __future__ import annotations

import pkgutil
from importlib import import_module

from sqlalchemy import BigInteger, Integer, MetaData, String

METADATA = MetaData(
    naming_convention={
        "ix": "ix_%(table_name)s_%(column_0_N_name)s",
        "uq": "uq_%(table_name)s_%(column_0_N_name)s",
        "ck": "ck_%(table_name)s_%(constraint_name)s",
        "fk": "fk_%(table_name)s_%(column_0_N_name)s",
        "pk": "pk_%(table_name)s",
    }
)
"""All tables of the server. Constraints have names, so that a migration can speak of them."""

Counted = BigInteger().with_variant(Integer(), "sqlite")
"""A key that the database counts up; SQLite does so for INTEGER only, which has 64 bits there."""

Time = BigInteger()
"""Nanoseconds since the Unix epoch, by the server's clock unless the name says otherwise."""

Id = String(64)
"""An id as in ``core.ids``."""

Digest = String(64)
"""A SHA-256 as hex digits."""

_TABLES = ".tables"


def complete() -> MetaData:
    """Return ``METADATA`` with the tables of every room of the server in it."""
    package = import_module("amberbox.fleet")
    for info in pkgutil.walk_packages(package.__path__, f"{package.__name__}."):
        if info.name.endswith(_TABLES):
            import_module(info.name)
    return METADATA
