"""Assembles the page: one HTML file with its data, script and style, which loads nothing else."""

import base64
import functools
import gzip
import secrets
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jinja2
import plotly.offline
from markupsafe import Markup

from .tables import ShownTable

HERE = Path(__file__).parent
SHARED = (
    "address", "selection", "colours", "table", "plots", "curves", "compare", "explore", "detail",
)  # fmt: skip
"""Scripts of this page and of the live one."""
SCRIPTS = ("data", "static", *SHARED, "start")


def file(name: str, folder: Path = HERE) -> str:
    """A script or style of the package."""
    return (folder / name).read_text(encoding="utf-8")


def render(content: Mapping[str, Any]) -> str:
    """The page that is one file, or with `live` in its content the page of `qnerf serve`, whose script and style are
    files of their own."""
    own: dict[str, Any] = {}
    if not content.get("live"):
        own["nonce"] = secrets.token_urlsafe(16)
        own["plotly"] = compressed(plotly.offline.get_plotlyjs())
        own["script"] = Markup("\n".join(file(f"{name}.js") for name in SCRIPTS))
        own["style"] = Markup(file("style.css"))
    return _environment().get_template("page.html").render(EMPTY | content | own)


def table(item: ShownTable) -> str:
    """One table as the page shows it."""
    return str(_environment().get_template("table.html").module.table(item))


def compressed(text: str) -> str:
    """gzip in base64: a third of the bytes; the same for the same text."""
    return base64.b64encode(gzip.compress(text.encode(), 6, mtime=0)).decode()


EMPTY = {
    "live": False,
    "filter": None,
    "absent": dict.fromkeys(("pictures", "curves"), ""),
    "note": "",
    "decisions": None,
    "verdicts": None,
    "forest": (),
    "parts": (),
}
"""What a page may leave out."""


@functools.lru_cache(maxsize=1)
def _environment() -> jinja2.Environment:
    """Jinja escapes every text from outside, or puts it into JSON that cannot close its element."""
    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader(HERE), autoescape=True, undefined=jinja2.StrictUndefined,
        trim_blocks=True, lstrip_blocks=True,
    )  # fmt: skip
    environment.globals["zip"] = zip
    environment.policies["json.dumps_kwargs"] = {"allow_nan": False, "separators": (",", ":")}
    return environment
