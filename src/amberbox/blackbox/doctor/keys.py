"""Who can read the store and its signing key: are both private, is the other half elsewhere."""

from __future__ import annotations

import stat
from collections.abc import Iterator

from amberbox.blackbox.doctor.finding import Finding, error, ok, warn
from amberbox.blackbox.doctor.host import Host
from amberbox.blackbox.doctor.subject import Subject
from amberbox.core.files import open_to_all

_BACKUP = "keep a copy of key.pub off the robot: amberbox verify needs it to prove anything"


def keys(subject: Subject, host: Host) -> Iterator[Finding]:
    """Look at the files of the key; the key itself is not read."""
    if subject.store is None:
        yield ok("keys", "none yet: they are made at the first start of the recorder")
        return
    yield _judged(subject)
    what = open_to_all(subject.store_path)
    if what:
        yield warn("store", what, f"chmod -R o-rwx {subject.store_path}")


def _judged(subject: Subject) -> Finding:
    private, public = subject.store_path / "key", subject.store_path / "key.pub"
    if not private.exists():
        what = "only key.pub is there" if public.exists() else "there are none"
        hint = "start the recorder with the package cryptography installed (amberbox[keep])"
        return warn("keys", f"{what}: what is recorded is not signed", hint)
    status = private.stat()
    mode = stat.S_IMODE(status.st_mode)
    if mode & 0o077:
        hint = f"chmod 600 {private}; if others could read it, delete both to get new ones"
        return error("keys", f"the private key is open to others (mode {mode:04o})", hint)
    if status.st_uid != subject.store_path.stat().st_uid:
        hint = f"chown it to the user who records: {private}"
        return error("keys", "the private key belongs to somebody else than the store", hint)
    if not public.exists():
        hint = "it is made anew from the private key at the next start of the recorder"
        return warn("keys", "key.pub is missing", hint)
    return ok("keys", f"key is private (mode {mode:04o}), key.pub is there", _BACKUP)
