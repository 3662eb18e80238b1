"""Which servers somebody is signed in to: a token and a pin each, in a file for its owner only."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from amberbox.core.errors import AmberboxError, UsageError
from amberbox.core.files import write_private

VARIABLE = "AMBERBOX_TOKEN"
_FILE = "servers.yaml"


@dataclass(frozen=True, slots=True)
class SignIn:
    """What is known of a server; ``pin`` is its authority's SHA-256, empty for one of the system.

    ``authority`` is that certificate, in PEM.
    """

    token: str = field(repr=False)
    pin: str = ""
    authority: str = ""


def path() -> Path:
    """Return where sign-ins are kept."""
    home = os.environ.get("XDG_CONFIG_HOME") or str(Path.home() / ".config")
    return Path(home) / "amberbox" / _FILE


def sign_in_of(url: str) -> SignIn | None:
    """Return what is kept of a server; None if nobody signed in to it here.

    Raises UsageError when others can read the file.
    """
    return _entry(_read().get(url))


def keep(url: str, entry: SignIn) -> None:
    """Keep a sign-in."""
    said = {"token": entry.token, "ca": f"sha256:{entry.pin}" if entry.pin else "",
            "authority": entry.authority}  # fmt: skip
    _write({**_read(), url: {key: value for key, value in said.items() if value}})


def forget(url: str) -> bool:
    """Forget a sign-in; tell whether there was one."""
    known = dict(_read())
    found = known.pop(url, None) is not None
    if found:
        _write(known)
    return found


def _entry(values: Any) -> SignIn | None:
    if not isinstance(values, Mapping):
        return None
    texts = {name: str(values.get(name) or "") for name in ("token", "ca", "authority")}
    return SignIn(texts["token"], texts["ca"].removeprefix("sha256:"), texts["authority"])


def _read() -> Mapping[str, Any]:
    import yaml

    file = path()
    try:
        with file.open(encoding="utf-8") as opened:
            if os.fstat(opened.fileno()).st_mode & 0o077:
                raise UsageError(f"others can read the tokens in {file}", f"chmod 600 {file}")
            found = yaml.safe_load(opened.read())
    except FileNotFoundError:
        return {}
    except (yaml.YAMLError, UnicodeDecodeError):
        raise AmberboxError(f"{file} cannot be read", "delete it and sign in again") from None
    return found if isinstance(found, Mapping) else {}


def _write(known: Mapping[str, Any]) -> None:
    import yaml

    file = path()
    file.parent.mkdir(parents=True, exist_ok=True, mode=0o700)
    write_private(file, yaml.safe_dump(dict(known)))
