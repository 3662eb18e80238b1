"""The unit of an output: the one declared in its mode file, else that of its monitor."""

from __future__ import annotations

from pathlib import Path

from amberbox import sim
from amberbox.blackbox.robot_folder.folder import load_folder
from amberbox.monitoring.plan_loader import load_plan
from amberbox.server.live.worker import output_facts

MODE = """\
name: heartbeat
mappings:
  - mapping:
      inputs: [sim_odom]
      outputs:
        - output: {name: alive, type: bool}
        - output: {name: rate_hz, type: float}
        - output: {name: silence, type: float, result: age_s, unit: ticks}
arguments: {}
"""


def test_a_unit_is_declared_or_the_monitors_own(tmp_path: Path) -> None:
    source = Path(sim.__file__).parent / "folder" / "black_box.yaml"
    (tmp_path / "black_box.yaml").write_bytes(source.read_bytes())
    (tmp_path / "robot.yaml").write_text("id: r\n")
    (tmp_path / "components").mkdir()
    (tmp_path / "components" / "odom.yaml").write_text(
        "component_name: odom\nmodes: [heartbeat.yaml]\n"
    )
    (tmp_path / "components" / "heartbeat.yaml").write_text(MODE)
    plan, problems = load_plan(load_folder(tmp_path))
    assert [problem for problem in problems if problem.is_error] == []
    (component,) = plan.components
    units = {output.name: output.unit for output in output_facts(component, "heartbeat")}
    assert units == {"alive": "", "rate_hz": "Hz", "silence": "ticks"}
