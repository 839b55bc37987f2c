"""Assembles the page: one HTML file with its data, script and style, which loads nothing else."""

import base64
import hashlib
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jinja2
import plotly.offline
from markupsafe import Markup

HERE = Path(__file__).parent
SCRIPTS = ("data", "filter", "selection", "table", "plots", "curves", "compare", "detail", "start")


@dataclass(frozen=True)
class Script:
    """A script that cannot close its own element, and its hash for the policy."""

    text: Markup
    digest: str


def script(text: str) -> Script:
    assert not re.search("</script|<!--", text, re.IGNORECASE)
    digest = base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()
    return Script(Markup(text), f"'sha256-{digest}'")


def policy(*scripts: Script) -> str:
    """A Content-Security-Policy that runs these scripts alone and loads nothing but pictures inside the page."""
    return "; ".join(
        [
            "default-src 'none'",
            f"script-src {' '.join(part.digest for part in scripts)}",
            "style-src 'unsafe-inline'",
            "img-src data: blob:",
            "base-uri 'none'",
            "form-action 'none'",
        ]
    )


def render(content: Mapping[str, Any]) -> str:
    """The page. Jinja escapes every text from outside, or puts it into JSON that cannot close its element."""
    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader(HERE), autoescape=True, undefined=jinja2.StrictUndefined,
        trim_blocks=True, lstrip_blocks=True,
    )  # fmt: skip
    environment.policies["json.dumps_kwargs"] = {"allow_nan": False, "separators": (",", ":")}
    own = script("\n".join((HERE / f"{name}.js").read_text(encoding="utf-8") for name in SCRIPTS))
    plots = script(plotly.offline.get_plotlyjs())
    style = Markup((HERE / "style.css").read_text(encoding="utf-8"))
    return environment.get_template("page.html").render(
        content, policy=policy(plots, own), plotly=plots.text, script=own.text, style=style
    )
