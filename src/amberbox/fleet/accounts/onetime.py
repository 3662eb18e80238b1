"""Passwords that the server makes for people: to be read out once, and changed at the first login.

Four groups of five characters of which none looks like another: 98 random bits.
"""

from __future__ import annotations

import secrets

ALPHABET = "abcdefghjkmnpqrstuvwxyz23456789"
_GROUPS, _LONG = 4, 5


def one_time_password() -> str:
    """Return a new one, such as ``k7mqd-2xwdn-pa4ch-ytr9b``."""
    groups = ("".join(secrets.choice(ALPHABET) for _ in range(_LONG)) for _ in range(_GROUPS))
    return "-".join(groups)
