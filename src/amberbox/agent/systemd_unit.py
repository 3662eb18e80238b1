"""The systemd unit that records and monitors a robot from boot on."""

from __future__ import annotations

import math
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from amberbox.blackbox.robot_folder.folder import RobotFolder
from amberbox.core.errors import UsageError
from amberbox.core.names import derive_id, is_id

MARK = "# Written by amberbox install-service; run it again rather than changing this file."
UNITS = Path("/etc/systemd/system")
_HOMES = ("/home", "/root", "/run/user")
_TEMPORARY = ("/tmp", "/var/tmp")  # private to a service with PrivateTmp
_WATCHDOG_S = 10
_CAPTURING = ("ethercat",)


@dataclass(frozen=True, slots=True)
class Service:
    """The parameters of a unit: folder, user, Python, name."""

    name: str
    user: str
    robot: str
    folder: Path
    store: Path
    write_s: float
    python: Path = Path(sys.executable)
    ring: Path | None = None
    verb: str = "record"
    """What runs: the recorder alone, or ``run`` that supervises it and what monitors."""
    captures: bool = False
    """Whether a source receives all frames of a network interface."""

    @property
    def unit(self) -> str:
        """Name of the unit."""
        return f"{self.name}.service"

    @property
    def path(self) -> Path:
        """Path of the unit file."""
        return UNITS / self.unit


def service_of(folder: RobotFolder, name: str, user: str, verb: str = "record") -> Service:
    """Describe the service of a robot folder; raise UsageError for a name systemd cannot use."""
    if not is_id(name) or name.startswith("-"):  # systemctl would read it as an option
        hint = f"--name {derive_id(name.lstrip('-') or 'robot')}"
        raise UsageError(f"'{name}' is no name for a service", hint)
    path, store = folder.path.resolve(), folder.store_path.resolve()
    options = folder.robot.store
    ring = (path / options.ring_path).resolve() if options.ring_path else None
    about = name, user, folder.robot.id, path, store, options.write_s
    captures = any(block.plugin in _CAPTURING for block in folder.blocks)
    return Service(*about, ring=ring, verb=verb, captures=captures)


def unit_text(service: Service) -> str:
    """Return the text of the unit file."""
    return "\n".join([MARK, *_unit(service), "", *_service(service), "", *_INSTALL, ""])


_INSTALL = ("[Install]", "WantedBy=multi-user.target")


def _unit(service: Service) -> Sequence[str]:
    return (
        "[Unit]",
        f"Description=Amberbox flight recorder of {_plain(service.robot)}",
        "# not after the network: the first seconds count, and sources wait for it themselves",
        "After=local-fs.target",
        f"RequiresMountsFor={argument(service.folder)} {argument(service.store)}",
        "StartLimitIntervalSec=0",
    )


def _service(service: Service) -> Sequence[str]:
    watchdog_s = max(_WATCHDOG_S, math.ceil(4 * service.write_s))
    return (
        "[Service]",
        "Type=notify",
        f"ExecStart={command_line(service)}",
        *(("ExecReload=/bin/kill -HUP $MAINPID",) if service.verb == "run" else ()),
        f"User={_plain(service.user)}",
        f"RuntimeDirectory={service.name}",
        f"WatchdogSec={watchdog_s}",
        "TimeoutStartSec=300",
        "Restart=always",
        "RestartSec=1",
        "KillMode=mixed",
        "TimeoutStopSec=15",
        "# when memory or the processor get short, the recorder is the last to suffer",
        "OOMScoreAdjust=-500",
        "Nice=-5",
        "IOSchedulingClass=best-effort",
        "IOSchedulingPriority=1",
        "NoNewPrivileges=yes",
        *(("AmbientCapabilities=CAP_NET_RAW",) if service.captures else ()),
        *_protection(service),
    )


def _protection(service: Service) -> Sequence[str]:
    """Return the settings that allow writing to the store only, and reading homes if needed."""
    at_home = any(_lies_in(path, _HOMES) for path in _needed(service))
    temporary = any(_lies_in(path, _TEMPORARY) for path in _needed(service))
    return (
        "ProtectSystem=strict",
        " ".join(_written(service)),
        f"ProtectHome={'read-only' if at_home else 'yes'}",
        f"PrivateTmp={'no' if temporary else 'yes'}",
    )


def _written(service: Service) -> Iterator[str]:
    yield f"ReadWritePaths={argument(service.store)}"
    if service.ring is not None:  # one in memory is gone after a boot
        yield argument(f"-{service.ring}")


def _needed(service: Service) -> Sequence[Path]:
    package, python = Path(__file__).resolve(), service.python
    ring = () if service.ring is None else (service.ring,)
    places = (service.folder, service.store, *ring)
    return *places, python, python.resolve(), Path(sys.prefix), package


def _lies_in(path: Path, places: Sequence[str]) -> bool:
    return any(path.is_relative_to(place) for place in places)


def command_line(service: Service) -> str:
    """Return the command that records, or runs everything, quoted for systemd."""
    words = (service.python, "-m", "amberbox", service.verb, "--quiet", service.folder)
    return " ".join(argument(word).replace("$", "$$") for word in words)


def argument(text: str | Path) -> str:
    """Quote a word for a unit file if it needs that; ``%`` would be a specifier."""
    escaped = _plain(str(text)).replace("\\", "\\\\").replace('"', '\\"')
    special = not escaped or any(c in escaped for c in " \t'\"\\;")
    return f'"{escaped}"' if special else escaped


def _plain(text: str) -> str:
    return text.replace("%", "%%").replace("\n", " ")
