"""Mosquitto as a process of its own, and clients that publish to it."""

from __future__ import annotations

import subprocess
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from paho.mqtt.client import Client
from paho.mqtt.enums import CallbackAPIVersion

from amberbox.testing.clock import PATIENCE_S, wait_until
from tests.support.processes import LOOPBACK, free_port, wait_for_listener


class Mosquitto:
    """A broker that can be killed and started again at the same port."""

    def __init__(
        self,
        folder: Path,
        lines: Sequence[str] = (),
        *,
        port: int | None = None,
        prefix: Sequence[str] = (),
        address: str = LOOPBACK,
    ) -> None:
        self.port = port or free_port()
        self.address = address
        self._prefix = prefix
        self.log = folder / "mosquitto.log"
        self._config = folder / "mosquitto.conf"
        settings = [f"listener {self.port} {address}", "allow_anonymous true", *lines]
        self._config.write_text("\n".join(settings) + "\n")
        self.process: subprocess.Popen[bytes] | None = None

    def start(self, *, waits: bool = True) -> None:
        """Run it, and wait until it listens."""
        with self.log.open("ab") as log:
            self.process = subprocess.Popen(
                [*self._prefix, "/usr/sbin/mosquitto", "-c", str(self._config)],
                stdout=log,
                stderr=log,
            )
        if waits:
            wait_for_listener(self.port, self.process, self.log)

    def kill(self) -> None:
        """End it as ``kill -9`` does."""
        if self.process is not None:
            self.process.kill()
            self.process.wait()

    def stop(self) -> None:
        """End it in order."""
        assert self.process is not None
        self.process.terminate()
        self.process.wait(PATIENCE_S)

    @property
    def block(self) -> dict[str, Any]:
        """Return the options of a source of this broker."""
        return {"broker": f"{self.address}:{self.port}"}


@contextmanager
def mosquitto(folder: Path, *lines: str) -> Iterator[Mosquitto]:
    """Run a broker; ``lines`` are more of its configuration."""
    broker = Mosquitto(folder, lines)
    broker.start()
    try:
        yield broker
    finally:
        broker.kill()


@contextmanager
def publisher(
    broker: Mosquitto, *, will: tuple[str, str] | None = None, name: str = ""
) -> Iterator[Client]:
    """Connect a client whose ``publish`` may be called at once; ``will`` is topic and text."""
    client = Client(CallbackAPIVersion.VERSION2, client_id=name)
    if will is not None:
        client.will_set(*will, qos=1, retain=True)
    client.connect(broker.address, broker.port, 5)
    client.loop_start()
    try:
        wait_until(client.is_connected, "the publisher is connected")
        yield client
    finally:
        client.disconnect()
        client.loop_stop()
