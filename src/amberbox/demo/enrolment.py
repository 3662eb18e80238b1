"""Prepare the server of the demonstration: four people, three robots, nothing to configure."""

from __future__ import annotations

import secrets
from collections.abc import Mapping
from pathlib import Path

from sqlalchemy import Connection

from amberbox.core.clock import SystemClock
from amberbox.demo.robots import GROUPS, IDS
from amberbox.fleet.accounts.actions import Role
from amberbox.fleet.accounts.groups import add_group
from amberbox.fleet.accounts.passwords import Passwords
from amberbox.fleet.accounts.robotkeys import add_robot
from amberbox.fleet.accounts.users import add_user
from amberbox.fleet.database.database import FILE, Database
from amberbox.fleet.serving.starting import make_folder
from amberbox.link.joining import JoinLine, join_line


def enrol(data: Path, urls: Mapping[str, str]) -> Mapping[str, JoinLine]:
    """Make a data folder with people and robots; return the line that each robot joins by.

    ``urls`` are the addresses at which the robots reach the server. The people have a password
    that nobody knows: they come by links.
    """
    make_folder(data)
    passwords = Passwords()
    hashed = passwords.hash(secrets.token_urlsafe())
    passwords.close()
    database = Database(data / FILE)
    try:
        with database.begin() as connection:
            return _enrolled(connection, SystemClock().wall_ns(), hashed, urls)
    finally:
        database.close()


def _enrolled(
    connection: Connection, now_ns: int, hashed: str, urls: Mapping[str, str]
) -> Mapping[str, JoinLine]:
    for role in Role:
        add_user(connection, now_ns, str(role), role, hashed)
    for group in sorted(set(GROUPS.values())):
        add_group(connection, now_ns, group)
    keys = {robot: add_robot(connection, now_ns, robot, [GROUPS[robot]]) for robot in IDS}
    return {robot: join_line(urls[robot], robot, key.text) for robot, key in keys.items()}
