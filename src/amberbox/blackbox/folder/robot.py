"""``robot.yaml``: who the robot is, where its record goes, and which server it reports to."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Literal

from amberbox.blackbox.folder.missions import MissionOptions
from amberbox.blackbox.folder.monitoring import MonitoringOptions
from amberbox.blackbox.folder.server import ServerOptions
from amberbox.blackbox.folder.triggers import IncidentOptions, TriggerOptions, repeated
from amberbox.core.ids import derive_id, is_id
from amberbox.core.options import option

WhenFull = Literal["overwrite", "stop"]
_SHARE = 8
"""A journal file, or the reserve, takes at most this part of the quota."""
_ROTATE_SHARE = 16
"""By itself a journal file takes at most this part: several grow, and as much is held free."""
_LEAST_QUOTA = 10_000_000
"""In less there is no room for events, the manifest and files that grow beside the record."""


@dataclass(frozen=True)
class LifetimeOptions:
    """How long the parts of the record are kept at most; without a value until room is needed."""

    raw: float | None = option(None, "journals, as the sources spoke", unit="s")
    columns: float | None = option(None, "their columns", unit="s")

    def check(self) -> Iterator[tuple[str, str]]:
        """Say which values cannot work."""
        for key in ("raw", "columns"):
            if (getattr(self, key) or 1) <= 0:
                yield key, "must be above 0"


@dataclass(frozen=True)
class StoreOptions:
    """Where and how the record is kept."""

    path: str = option("store", "folder of the record, relative to the robot folder")
    quota: int | None = option(None, "most that the record may take", unit="B")
    quota_percent: float = option(80.0, "the same as a share of the partition", unit="%")
    min_free: int = option(1_000_000_000, "room that stays free on the partition", unit="B")
    write_s: float = option(0.1, "a crash of the box loses at most this much", unit="s")
    sync_s: float = option(1.0, "a power cut loses at most this much more", unit="s")
    ring_s: float = option(300.0, "how long items of class ring are kept", unit="s")
    queue: int = option(64_000_000, "memory for messages that wait for the disk", unit="B")
    keep_min: float = option(86_400.0, "the newest data are not deleted for room", unit="s")
    when_full: WhenFull = option("overwrite", "delete the oldest data, or stop recording")
    reserve: int = option(16_000_000, "room set aside for the last events", unit="B")
    lifetime: LifetimeOptions = option(LifetimeOptions(), "when data go though there is room")
    ring_path: str = option("", "folder for the ring, such as one in memory; else in the store")
    rotate_mb: float = option(64.0, "a journal file is closed at this size", unit="MB")
    rotate_s: float = option(600.0, "a journal file is closed at this age", unit="s")

    @property
    def rotate_bytes(self) -> int:
        """Size of a journal file; smaller than its default where the quota is small."""
        size = int(self.rotate_mb * 1e6)
        is_set = self.rotate_mb != StoreOptions.rotate_mb
        return self._share(size, _SHARE if is_set else _ROTATE_SHARE)

    @property
    def reserve_bytes(self) -> int:
        """Size of the reserve; smaller than its default where the quota is small."""
        return self._share(self.reserve)

    def _share(self, size: int, share: int = _SHARE) -> int:
        return size if self.quota is None else min(size, self.quota // share)

    def _too_small(self, quota: int) -> str:
        if quota <= 0:
            return "must be above 0"
        least = f"{_LEAST_QUOTA / 1e6:g} MB"
        return f"must be at least {least}: in less there is no room to record beside what stays"

    def _too_large(self) -> Iterator[tuple[str, str]]:
        """Name what was set to more than its share of the quota; the defaults shrink instead."""
        sizes = {"rotate_mb": int(self.rotate_mb * 1e6), "reserve": self.reserve}
        for key, size in sizes.items():
            is_set = getattr(self, key) != getattr(StoreOptions, key)
            if is_set and self._share(size) < size:
                most = f"{(self.quota or 0) / _SHARE / 1e6:g}"
                unit = "" if key == "rotate_mb" else " MB"
                yield key, f"must be at most {most}{unit}, an eighth of the quota"

    def check(self) -> Iterator[tuple[str, str]]:
        """Say which values cannot work."""
        above_zero = ("write_s", "sync_s", "ring_s", "queue", "rotate_mb", "rotate_s")
        for key in above_zero:
            if getattr(self, key) <= 0:
                yield key, "must be above 0"
        for key in ("min_free", "keep_min", "reserve"):
            if getattr(self, key) < 0:
                yield key, "must not be below 0"
        if self.quota is not None and self.quota < _LEAST_QUOTA:
            yield "quota", self._too_small(self.quota)
        else:
            yield from self._too_large()
        if not 0 < self.quota_percent <= 100:
            yield "quota_percent", "must be above 0 and at most 100"
        if self.sync_s < self.write_s:
            yield "sync_s", f"must not be below write_s ({self.write_s:g} s)"


@dataclass(frozen=True)
class RobotConfig:
    """Everything in ``robot.yaml``."""

    id: str = option("", "name of the robot in addresses and on the server")
    model: str = option("", "make and model")
    software_version: str = option("", "version of the robot's own software")
    store: StoreOptions = option(StoreOptions(), "where and how the record is kept")
    server: ServerOptions | None = option(None, "the fleet server this robot reports to")
    triggers: Sequence[TriggerOptions] = option((), "what makes an incident")
    missions: Sequence[MissionOptions] = option((), "what begins and ends missions")
    incidents: IncidentOptions = option(IncidentOptions(), "limits of incidents")
    monitoring: MonitoringOptions = option(MonitoringOptions(), "what holds for all monitors")

    def check(self) -> Iterator[tuple[str, str]]:
        """Say what is wrong with the id, and which names are there twice."""
        for name in repeated(self.triggers):
            yield "triggers", f"there are several called '{name}'"
        for name in repeated(self.missions):
            yield "missions", f"there are several called '{name}'"
        if self.id and not is_id(self.id):
            yield "id", f"'{self.id}' is no id (a-z 0-9 _ . -); '{derive_id(self.id)}' would be one"
