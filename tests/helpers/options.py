"""`python -m tests.helpers.options`: writes the tables of docs/configuration.md from conf/."""

import re
from pathlib import Path

from tests.helpers.configs import CONF, ROOT

PAGE = ROOT / "docs" / "configuration.md"
MARK = "<!-- made by: python -m tests.helpers.options -->\n"
LINE = re.compile(r"^( *)([\w@/]+):(?:\s+(.*?))??(?:\s+#\s*(.*))?$")
PURPOSE = {
    "ansatz": "the circuit",
    "budget": "how many steps, of any recipe",
    "cameras": "pose refinement",
    "contraction": "how unbounded space is mapped to a finite one",
    "encoder": "how points are encoded",
    "experiment": "named changes of the whole configuration",
    "field": "which heads are circuits",
    "hash": "table sizes of the hash grid",
    "head": "the kind of head, mounted as `head@density` and `head@color`; of a signal, `head`",
    "needs": "options that the scene decides",
    "qiren": "layers (L) and re-uploadings (S) of circuits",
    "sampler": "where rays are sampled",
    "scene": "the images, or the signal",
    "shading": "where along a ray colours are computed",
    "train": "the recipe",
}
"""Group -> what it chooses."""
MOST_NAMED = 20
"""Choices of a group that the page names; of more it gives the number."""


def made() -> str:
    """The part of the page below the mark."""
    groups = sorted(path for path in CONF.iterdir() if path.is_dir() and path.name != "hydra")
    rows = [group_row(path) for path in groups]
    parts = ["## Groups", table(("group", "chooses", "choices"), rows)]
    options = table(("option", "default", "what it is"), option_rows(CONF / "config.yaml"))
    return "\n\n".join([*parts, "## Options of every run", options]) + "\n"


def group_row(path: Path) -> tuple[str, str, str]:
    names = sorted(file.stem for file in path.glob("*.yaml") if file.stem != "base")
    choices = ", ".join(f"`{name}`" for name in names) if len(names) < MOST_NAMED else f"{len(names)} of them"
    return f"[`{path.name}`](../conf/{path.name})", PURPOSE[path.name], choices


def option_rows(file: Path) -> list[tuple[str, str, str]]:
    """Dotted key, value and comment of each option, in the order of the file; Hydra's own keys are left out."""
    rows, parents = [], []
    for line in file.read_text().splitlines():
        match = LINE.match(line)
        if not match:
            continue
        depth, key, value, comment = len(match[1]) // 2, match[2], match[3] or "", match[4] or ""
        parents = [*parents[:depth], key]
        if parents[0] not in ("defaults", "hydra") and (value or comment):
            same = re.fullmatch(r"\$\{([\w.]+)\}", value)
            shown = f"as `{same[1]}`" if same else f"`{value}`" if value else ""
            rows.append((f"`{'.'.join(parents)}`", shown, comment.replace("|", "\\|")))
    return rows


def table(header: tuple[str, ...], rows: list[tuple[str, ...]]) -> str:
    lines = [header, ("---",) * len(header), *rows]
    return "\n".join(f"| {' | '.join(cells)} |" for cells in lines)


def main() -> None:
    PAGE.write_text(PAGE.read_text().partition(MARK)[0] + MARK + "\n" + made())


if __name__ == "__main__":
    main()
