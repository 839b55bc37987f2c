"""`qnerf report STORE`: see `--help`."""

import argparse
from collections.abc import Callable, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import pandas as pd
from rich.console import Console

import qnerf
from qnerf.cli.numbers import count
from qnerf.records.files import replace

from .. import command, output
from . import content, curves, page, parts, pictures
from .figures import draw
from .verdicts import verdicts

DESCRIPTION = """\
Writes one self-contained HTML page about a store of runs: a table of runs, interactive plots, curves, pictures and
configurations side by side, tables and figures. It opens from disk in any browser and loads nothing from the network.
"""
EXAMPLES = """\
  {} runs --out report
  {} runs --out sweep.html --filter scene_name=poster --title "Poster, 3 seeds"
  {} runs --max-images 0
"""


def main(arguments: Sequence[str] | None = None) -> None:
    options = parser().parse_args(arguments)
    console = Console(stderr=True)
    with console.status("reading runs") as status:
        frame = command.chosen(options)
        path = write(page.render(page_content(frame, options, status.update)), options.out)
    console.print(
        f"{path}: {len(frame):,} runs, {path.stat().st_size / 1e6:.1f} MB",
        highlight=False,
        markup=False,
        soft_wrap=True,
    )


def parser() -> argparse.ArgumentParser:
    made = command.parser("report", DESCRIPTION, EXAMPLES)
    command.add_runs(made)
    command.add_columns(made)
    made.add_argument(
        "--out",
        default="report",
        metavar="DIR",
        help="a folder, which gets index.html, or a .html file (default: report)",
    )
    made.add_argument("--title", default="Runs", help="the page's heading (default: Runs)")
    command.add_baseline(made, "what verdicts compare with; default: the classical configuration")
    command.add_judged(made)
    made.add_argument(
        "--max-images",
        type=count,
        default=pictures.MAX_VIEWS,
        metavar="N",
        help="held-out views on the page, at most (default: %(default)s; each is a render and a depth)",
    )
    return made


def page_content(frame: pd.DataFrame, options: argparse.Namespace, say: Callable[[str], None]) -> dict[str, Any]:
    """The values of the page's template. say: called with the name of each part, before it is made."""
    frame = content.prepared(frame)
    order = content.order(frame)
    most = options.max_images
    say("pictures")
    drawn = pictures.gather(frame, order if most else [], most)
    say("curves")
    logged = curves.gather(frame, order)
    say("tables and figures")
    judged = {name: getattr(options, name) for name in ("baseline", "metric", "within")}
    sections = parts.parts(frame, **judged)
    named = [(part.id, part.name) for part in sections]
    return {
        "title": options.title,
        "store": options.store,
        "filter": options.filter,
        "total": f"{len(frame):,}",
        "dates": content.dates(frame),
        "states": list(frame["state"].fillna("unknown").value_counts().items()),
        "version": qnerf.__version__,
        "written": f"{datetime.now(UTC):%Y-%m-%d %H:%M} UTC",
        "verdicts": verdicts(frame, **judged),
        "forest": draw("forest", frame, **judged)[0],
        "sections": [
            section
            for section in (SECTIONS[0], *named[:1], *SECTIONS[1:], *named[1:])
            if section[0] != "curves-section" or logged or drawn.files
        ],
        "note": drawn.note,
        "absent": {
            "pictures": content.no_pictures(drawn),
            "curves": content.no_curves(logged),
        },
        "parts": sections,
        "data": content.data(frame, drawn, logged),
    }


def write(html: str, out: str) -> Path:
    """Writes the page to the file `out`, or to index.html in the folder `out`; returns its path."""
    path = Path(out)
    path = path if path.suffix == ".html" else path / "index.html"
    output.make_folder(path.parent)
    replace(path, html.encode(errors="backslashreplace"), durable=False)
    return path


SECTIONS = (
    ("verdicts-section", "Verdicts"),
    ("curves-section", "Curves"),
    ("runs-section", "Runs"),
    ("compared-section", "Compare"),
    ("explore-section", "Explore"),
)

if __name__ == "__main__":
    command.run(main)
