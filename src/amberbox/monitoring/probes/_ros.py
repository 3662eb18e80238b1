"""Shared parts of the ROS 1 probes: names with their master, and read-only calls of it."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager

from amberbox.blackbox.sources.ros1.master import (
    DEFAULT_MASTER,
    RosMaster,
    SubscriberSettings,
    global_name,
    is_global_name,
    master_uri,
)
from amberbox.core.errors import UsageError

CALLER_ID = "/amberbox_probe"
_WAIT_S = 2.0  # for one call; a measurement makes two at most


def settings_for(master: str) -> SubscriberSettings:
    """Return how to call a master, ``HOST``, ``HOST:PORT`` or its URI; empty is the usual one."""
    address = master or os.environ.get("ROS_MASTER_URI", "") or DEFAULT_MASTER
    try:
        return SubscriberSettings(
            master_uri=master_uri(address), caller_id=CALLER_ID, timeout_s=_WAIT_S
        )
    except ValueError as error:
        raise UsageError(f"'{address}' is no ROS master: {error}", "such as robot:11311") from error


def name_and_settings(subject: str) -> tuple[str, SubscriberSettings]:
    """Split ``/name@master`` into the name and how to call the master."""
    name, _, master = subject.strip().partition("@")
    name = global_name(name)
    if not is_global_name(name):
        raise UsageError(f"'{subject}' is no ROS name", "such as /scan_front")
    return name, settings_for(master)


@contextmanager
def master_of(settings: SubscriberSettings) -> Iterator[RosMaster]:
    """Open the connection to a master, and close it."""
    master = RosMaster(settings)
    try:
        yield master
    finally:
        master.close()
