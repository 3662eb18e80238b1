"""Draw variables over time: PNG, SVG or PDF, or an HTML page with zoom that needs no network."""

from __future__ import annotations

import argparse
from collections.abc import Callable

from amberbox.cli._output import add_range, opened, tell, writable
from amberbox.cli._plot_curves import Drawing, drawing
from amberbox.cli._plot_image import draw_image
from amberbox.cli._plot_page import draw_page
from amberbox.cli._server import add_where
from amberbox.cli._window import add_window
from amberbox.core.errors import UsageError

_DRAW: dict[str, Callable[[Drawing], bytes]] = {
    "html": draw_page,
    "png": lambda plot: draw_image(plot, "png"),
    "svg": lambda plot: draw_image(plot, "svg"),
    "pdf": lambda plot: draw_image(plot, "pdf"),
}


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the verb's arguments."""
    add_where(parser, "robot folder, store or recording file")
    parser.add_argument("item", metavar="ITEM", help="data item; 'amberbox items' lists them")
    parser.add_argument("variables", metavar="VAR", nargs="+", help="as for 'amberbox query'")
    add_range(parser)
    add_window(parser)
    parser.add_argument(
        "--points", type=int, default=4000, metavar="N",
        help="draw at most N rows, keeping extremes (default: 4000)",
    )  # fmt: skip
    parser.add_argument("--local", action="store_true", help="times of this computer's zone")
    parser.add_argument(
        "-o", "--output", metavar="FILE", required=True, help="file ending in html, png, svg or pdf"
    )


def run(args: argparse.Namespace) -> int:
    """Draw and write the file."""
    kind = args.output.rpartition(".")[2].lower()
    if kind not in _DRAW:
        raise UsageError(f"cannot draw to {args.output}", "end the name in html, png, svg or pdf")
    target = writable(args.output)
    with opened(args.where) as record:
        plot = drawing(record, args)
    target.write_bytes(_DRAW[kind](plot))
    tell(plot.notes)
    print(f"{target}: {len(plot.curves)} curves over {plot.rows} rows")
    return 0
