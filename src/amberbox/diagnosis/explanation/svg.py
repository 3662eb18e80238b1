"""An explanation as one self-contained SVG image."""

from __future__ import annotations

from collections.abc import Sequence

from amberbox.diagnosis.explanation.drawing import Box, Drawing, Stroke, drawn
from amberbox.diagnosis.explanation.explanation import Explanation
from amberbox.diagnosis.explanation.lettering import SIZE, SMALL, escaped

LIGHT = (
    ("text", "font-family:Helvetica,Arial,'Liberation Sans',sans-serif;fill:#1b1f24"),
    (".ground", "fill:#ffffff"),
    (".title", "font-weight:bold"),
    (".note,.small", "fill:#57606a"),
    (".box", "fill:#f6f8fa;stroke:#57606a;stroke-width:1"),
    (".leading,.present", "fill:#fff1d6;stroke:#8a4b00;stroke-width:2"),
    (".unexplained", "fill:#fde7f3;stroke:#99286e;stroke-width:2"),
    (".contradicted", "fill:#ffffff;stroke:#57606a;stroke-width:1.5;stroke-dasharray:5 4"),
    (".lost", "fill:#e7f0fb;stroke:#1f5fa8"),
    (".bar", "fill:#d0d7de"),
    (".share", "fill:#b35c00"),
    (".edge", "fill:none;stroke:#8c959f;stroke-width:1.2"),
    (".strong", "stroke:#8a4b00;stroke-width:1.8"),
    (".missing", "stroke-dasharray:5 4"),
    (".tip", "fill:#8c959f"),
    (".strongtip", "fill:#8a4b00"),
)
DARK = (
    ("text", "fill:#e6edf3"),
    (".ground", "fill:#0d1117"),
    (".note,.small", "fill:#a5afba"),
    (".box", "fill:#161b22;stroke:#8b949e"),
    (".leading,.present", "fill:#3a2500;stroke:#e0a13a"),
    (".unexplained", "fill:#3b1230;stroke:#e58ac0"),
    (".contradicted", "fill:#0d1117;stroke:#8b949e"),
    (".lost", "fill:#0f2440;stroke:#6ea8ec"),
    (".bar", "fill:#30363d"),
    (".share", "fill:#e0a13a"),
    (".edge", "stroke:#768390"),
    (".strong", "stroke:#e0a13a"),
    (".tip", "fill:#768390"),
    (".strongtip", "fill:#e0a13a"),
)
"""Colours by kind; every rule counts only in images of ours, as pages may hold several."""


def style() -> str:
    """Return the style sheet: light, and dark where the screen is."""
    return f"{_rules(LIGHT)}@media (prefers-color-scheme:dark){{{_rules(DARK)}}}"


def _rules(rules: Sequence[tuple[str, str]]) -> str:
    return "".join(
        f"{','.join(f'.why {name}' for name in names.split(','))}{{{body}}}\n"
        for names, body in rules
    )


def as_svg(explanation: Explanation) -> str:
    """Draw causes on the left, what they cost in the middle, what is seen on the right.

    The image needs nothing from outside and runs no script. It is as large as its contents, and
    light or dark as the reader's screen is.
    """
    drawing = drawn(explanation)
    size = f"{drawing.width:g} {drawing.height:g}"
    return "\n".join(
        (
            f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {size}" role="img" '
            f'width="{drawing.width:g}" height="{drawing.height:g}" '
            'class="why">',
            f"<title>{escaped(explanation.headline)}</title>",
            f"<desc>{escaped(_description(explanation))}</desc>",
            f"<style>{style()}</style>",
            f'<rect class="ground" width="{drawing.width:g}" height="{drawing.height:g}"/>',
            *(_stroke(stroke) for stroke in drawing.strokes),
            *(_box(box) for box in drawing.boxes),
            *_texts(drawing),
            "</svg>",
            "",
        )
    )


def _description(explanation: Explanation) -> str:
    """Tell those who cannot see the image what it shows."""
    seen = [seen.text for seen in explanation.because]
    causes = [node.text for node in explanation.graph.nodes if node.kind == "cause"]
    return f"Possible causes: {'; '.join(causes)}. Symptoms explained: {'; '.join(seen)}."


def _stroke(stroke: Stroke) -> str:
    names = f"edge{' strong' * stroke.leading}{' missing' * stroke.missing}"
    path = f'<path class="{names}" d="{stroke.path}"/>'
    if stroke.tip is None:
        return path
    x, y = stroke.tip
    kind = "strongtip" if stroke.leading else "tip"
    return f'{path}<path class="{kind}" d="M{x:g} {y:g}l-7 -3.5v7z"/>'


def _box(box: Box) -> str:
    shape = f'x="{box.x:g}" y="{box.y:g}" width="{box.width:g}" height="{box.height:g}"'
    parts = [f'<rect class="box {box.kind}" {shape} rx="5"/>']
    if box.share is not None:
        wide = box.width - 16
        bar = f'x="{box.x + 8:g}" y="{box.y + box.height - 12:g}" height="5"'
        parts.append(f'<rect class="bar" {bar} width="{wide:g}"/>')
        parts.append(f'<rect class="share" {bar} width="{wide * box.share:.1f}"/>')
    return "".join(parts)


def _texts(drawing: Drawing) -> list[str]:
    return [
        f'<text class="{line.kind}" x="{line.x:g}" y="{line.y:g}" '
        f'font-size="{SMALL if line.kind == "small" else SIZE}">{escaped(line.text)}</text>'
        for line in drawing.lines
    ]
