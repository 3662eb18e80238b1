"""A whole server that starts, answers a request to every route that reads, and stops."""

from __future__ import annotations

import http.client
import json
import os
import re
import signal
import sys
import threading
from pathlib import Path

from amberbox.core.clock import SystemClock
from amberbox.server import start
from amberbox.server.accounts.passwords import HashCost, Passwords
from amberbox.server.accounts.permissions import Role
from amberbox.server.accounts.robots import add_robot
from amberbox.server.accounts.sessions import begin_session
from amberbox.server.accounts.users import add_user
from amberbox.server.app import rules
from amberbox.server.config import ListenOptions
from amberbox.server.database import FILE, ServerDatabase
from amberbox.server.http.auth import COOKIE
from amberbox.testing.clock import PATIENCE_S


def main(folder: Path, port: int) -> None:
    """Serve until every route was requested; the statuses go to stdout as JSON."""
    start.make_folder(folder)
    secret = _prepare(folder)
    found: dict[str, int] = {}
    asking = threading.Thread(target=_ask, args=(port, secret, found), daemon=True)
    start.run(folder, ListenOptions(port=port), begun=lambda _: asking.start())
    asking.join(PATIENCE_S)
    print(json.dumps(found))


def _prepare(folder: Path) -> str:
    """Add an admin and a robot; return the secret of the admin's session."""
    database, passwords = ServerDatabase(folder / FILE), Passwords(HashCost(1, 8, 1))
    with database.begin() as connection:
        now_ns = SystemClock().wall_ns()
        hashed = passwords.hash("a long enough passphrase")
        admin = add_user(connection, now_ns, "admin", Role.ADMIN, hashed)
        add_robot(connection, now_ns, "ropod_001")
        session = begin_session(connection, now_ns, admin.user_id, "127.0.0.1")
    passwords.close()
    database.close()
    return session.secret


def _ask(port: int, secret: str, found: dict[str, int]) -> None:
    try:
        paths = json.loads(_get(port, secret, "/api/v1/openapi.json", found))["paths"]
        pages = [path for method, path in rules() if method == "GET" and "{" not in path]
        for path in [*pages, *paths]:
            if path not in found and (path not in paths or "get" in paths[path]):
                _get(port, secret, path, found)
    finally:
        os.kill(os.getpid(), signal.SIGTERM)


def _get(port: int, secret: str, path: str, found: dict[str, int]) -> bytes:
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=PATIENCE_S)
    known = {"robot": "ropod_001", "name": "admin"}
    url = re.sub(r"{(\w+)}", lambda name: known.get(name[1], "nothing"), path)
    connection.request("GET", url, headers={"Cookie": f"{COOKIE}={secret}"})
    answer = connection.getresponse()
    found[path] = answer.status
    body = answer.read()
    connection.close()
    return body


if __name__ == "__main__":
    main(Path(sys.argv[1]), int(sys.argv[2]))
