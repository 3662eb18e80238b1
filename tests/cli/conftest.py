"""What tests of verbs share: folders and files that verbs are given, and a terminal."""

from __future__ import annotations

import io
import socket
from pathlib import Path
from typing import Any

import pytest

from tests.diagnosis.fmea.small import TEXT


class Terminal(io.StringIO):
    """A stream that says it is a terminal."""

    def isatty(self) -> bool:
        return True


@pytest.fixture
def small(tmp_path: Path) -> Path:
    """A small ``fmea.yaml``."""
    path = tmp_path / "fmea.yaml"
    path.write_text(TEXT, encoding="utf-8")
    return path


@pytest.fixture
def no_sockets(monkeypatch: pytest.MonkeyPatch) -> None:
    """Make every socket an error."""

    def refuse(*arguments: Any, **more: Any) -> None:
        raise AssertionError("check opened a socket")

    monkeypatch.setattr(socket.socket, "__init__", refuse)
