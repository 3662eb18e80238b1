"""How the server itself is, and what it watches over several robots."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from fastapi import Request, Response

from amberbox.fleet.api.access import Fleet, services_of
from amberbox.fleet.api.clock import read_clock
from amberbox.fleet.api.health import read_health
from amberbox.fleet.api.system import read_status
from amberbox.fleet.metrics.figures import families
from amberbox.fleet.metrics.troubles import troubles
from amberbox.fleet.pages.page import Pages, render
from amberbox.fleet.state.damaged import damaged_files

routes = Pages()

_LOW, _VERY_LOW = 0.1, 0.03
"""Of the disk: below this it needs somebody soon, below that at once."""


@dataclass(frozen=True, slots=True)
class Disk:
    """Room on the disk of the data folder, in bytes."""

    free: float
    whole: float

    @property
    def level(self) -> str:
        """Return how that is."""
        share = self.free / self.whole if self.whole else 1.0
        return "error" if share < _VERY_LOW else "warn" if share < _LOW else "ok"


@routes.get("/admin/health", "metrics.read")
def show_health(request: Request, fleet: Fleet) -> Response:
    """Show the server's own figures."""
    found = _figures(request)
    with fleet.database.reading() as connection:
        damaged = sorted(damaged_files(connection, fleet.clock.wall_ns()).items())
    disk = Disk(found["amberbox_disk_free_bytes"], found["amberbox_disk_bytes"])
    return render(request, "admin/health.html", figures=found, disk=disk,
                  health=read_health(fleet, Response()).status,
                  troubles=troubles(fleet), damaged=damaged, clock=read_clock(fleet))  # fmt: skip


@routes.get("/admin/system", "status.read")
def show_system(request: Request, fleet: Fleet) -> Response:
    """Show teams and the system as the server watches them."""
    return render(request, "admin/system.html", folders=read_status(fleet))


def _figures(request: Request) -> Mapping[str, float]:
    """Return figures by name; those that are told by state as ``name:state``."""
    received = request.app.state.received
    return {
        ":".join((family.name, *sample.labels.values())): sample.value
        for family in families(services_of(request), received)
        for sample in family.samples
    }
