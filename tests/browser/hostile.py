"""Names and texts that must be escaped wherever a page shows them."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from xml.sax.saxutils import quoteattr

from tests.support.experiments import bpmn

MARKUP = '<img src=x onerror="document.title=1">'
SCRIPT = '"><script>document.title=1</script>'
TEMPLATE = "{{7*7}} ${7*7} ';--"
BACKWARDS = "\u202eflesti\u202c itself"
"""Written from right to left by a mark that turns what follows."""

COMPONENT = f"arm {MARKUP}"
"""A component of ``ropod_002``."""
OUTPUT = SCRIPT
"""An output of that component."""
MODEL = f"Ropod 2 {MARKUP}"
"""What the folder of ``ropod_002`` calls its model."""
ITEM = "hostile"
"""A data item of ``ropod_001`` with variables at the paths ``FIELDS`` that hold ``TEXTS``."""
FIELDS: Sequence[str] = (MARKUP.replace('"', ""), BACKWARDS)
TEXTS: Sequence[str] = (MARKUP, SCRIPT, TEMPLATE, BACKWARDS)
MISSION = f"transport {MARKUP}"
"""Name of the mission ``transport-2`` of ``ropod_001``."""
NOTE = f"{SCRIPT} {BACKWARDS}"
"""A note on the acknowledged alarm, and its reason."""
EVENT = f"somebody said {SCRIPT}"
"""An event of ``ropod_002``."""
EXPERIMENT = "odd"
"""An uploaded experiment whose steps have hostile names and texts, and a field of each kind."""
RUN, EARLIER_RUN = "r-00000000000000aa", "r-00000000000000bb"
"""Its runs on ``ropod_002``: one under way, and one that was aborted."""


def experiment_files() -> Mapping[str, bytes]:
    """Return the files of the experiment."""
    drawn = bpmn(
        [
            '<startEvent id="start"/>',
            f"<userTask id='ask' name={quoteattr(MARKUP)}/>",
            f"<serviceTask id='drive' name={quoteattr(SCRIPT)}/>",
            f"<endEvent id='end' name={quoteattr(TEMPLATE)}/>",
        ],
        ["start ask", "ask drive", "drive end"],
        [("operator", "start ask end"), ("robot", "drive")],
    )
    fields = {
        "seen": {"kind": "pass_fail", "label": MARKUP},
        "sure": {"kind": "confirm", "label": SCRIPT},
        "far": {"kind": "number", "unit": "m", "min": 0, "max": 9.5, "label": TEMPLATE},
        "which": {"kind": "choice", "choices": ["left", MARKUP]},
        "said": {"kind": "text", "required": False},
    }  # fmt: skip
    about = {
        "experiment": {
            "title": f"Odd {MARKUP}", "description": SCRIPT, "safety": NOTE, "duration": "2 min",
            "parameters": {"way_m": {"min": 0, "max": 2, "default": 1, "description": MARKUP}},
        },
        "steps": {
            "ask": {"text": SCRIPT, "expected": MARKUP, "deviation": BACKWARDS, "fields": fields},
            "drive": {"action": "drive", "parameters": {"way_m": "=way_m"}},
        },
    }  # fmt: skip
    yaml = json.dumps(about).encode()
    return {f"{EXPERIMENT}.bpmn": drawn.encode(), f"{EXPERIMENT}.yaml": yaml}


EQUATIONS = "odd"
"""A model of equations of ``ropod_001`` whose names are hostile."""


def model_files() -> Mapping[str, bytes]:
    """Return models: one with hostile names, one of 94 equations, one of components.

    ``motion`` has residuals of what ``record.py`` writes: one that the robot's speed is over, and
    one that cannot be computed.
    """
    odd = {
        "kind": "equations", "unknowns": [MARKUP, "x" * 200], "known": [SCRIPT],
        "equations": {
            MARKUP: {"variables": [MARKUP, SCRIPT, "x" * 200], "faults": [TEMPLATE, MARKUP]},
            SCRIPT: {"variables": [MARKUP], "faults": [BACKWARDS]},
            "y" * 200: {"variables": ["x" * 200], "faults": [SCRIPT]},
        },
    }  # fmt: skip
    power = {
        "kind": "components",
        "types": {
            MARKUP: {
                "ports": {"in": ["on", "off"], "out": ["on", "off"]},
                "modes": {
                    "closed": {"nominal": True, "constraints": ["out == in"]},
                    "tripped": {"constraints": ["out == off"]},
                },
            }
        },
        "components": dict.fromkeys(("main", "arm", "base"), MARKUP),
        "connections": [["main.out", "arm.in", "base.in"]],
        "steps": [{"observe": {"main.in": "on", "arm.out": "off"}}],
    }
    large = {
        "kind": "equations", "unknowns": [f"unknown_{n}" for n in range(88)], "known": ["sensor"],
        "equations": {
            f"equation_{n}": {
                "variables": [f"unknown_{n % 88}", f"unknown_{n * 7 % 88}", "sensor"],
                "faults": [f"fault_{n}"] if n % 3 == 0 else [],
            }
            for n in range(94)
        },
    }  # fmt: skip
    motion = {
        "kind": "equations", "unknowns": ["v", "w"],
        "known": {"speed": "ros_ropod_odom.twist_linear_x", "y": "ros_ropod_odom.pose_y"},
        "equations": {
            "wheels": {"solve": {"v": "0 * y"}, "component": "base"},
            "odometry": {"residual": "speed - v", "component": MARKUP},
            "turning": {"residual": "w - v"},
        },
        "residuals": {
            "speed": {"equations": ["wheels", "odometry"], "threshold": 0.55},
            MARKUP: {"equations": ["wheels", "turning"]},
        },
    }  # fmt: skip
    files = {EQUATIONS: odd, "power": power, "large": large, "motion": motion}
    return {f"models/{name}.yaml": json.dumps(one).encode() for name, one in files.items()}


COMMAND = "c0" * 16
"""A command of ``ropod_001`` whose run, reason and result are hostile."""
