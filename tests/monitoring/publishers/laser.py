"""The paper's laser scanners as a plan, and statuses of theirs."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

from amberbox.core.clock import NS
from amberbox.core.types import Output, Status
from amberbox.monitoring.plan import ComponentPlan, ModePlan, MonitoringPlan

T0_NS = 1_790_000_000 * NS
BOTH: Mapping[str, Output] = {"front_laser_working": True, "rear_laser_working": True}
DEVICE = ModePlan("laser_device", "laser_device_monitor", None, description="Devices are there")
HEARTBEAT = ModePlan("laser_heartbeat", "laser_heartbeat_monitor", None)
PLAN = MonitoringPlan(
    "ropod_001",
    "abc",
    (
        ComponentPlan("laser", "laser", (DEVICE, HEARTBEAT), description="Laser scanners"),
        ComponentPlan("docker", "docker"),
    ),
)
COMPONENT = Status("ropod_001", "laser", "", "ok", "nominal", {}, (), T0_NS, T0_NS, "", "abc")
OF_DEVICE = replace(COMPONENT, mode="laser_device", outputs=BOTH)
OF_HEARTBEAT = replace(OF_DEVICE, mode="laser_heartbeat", measured_ns=T0_NS + NS // 2)
STATUSES = [COMPONENT, OF_DEVICE, OF_HEARTBEAT]
