"""`python -m tests.helpers.options`: writes the tables of docs/configuration.md from the comments in conf/."""

import itertools
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
MOUNTED = {"head": "density"}
"""Where a group's options are, when not under its own name; for heads, the colour head has the same ones."""


def made() -> str:
    """The part of the page below the mark."""
    groups = {
        path: sorted(path.glob("*.yaml")) for path in sorted(CONF.iterdir()) if path.is_dir() and path.name != "hydra"
    }
    parts = [
        "## Groups",
        table(("group", "chooses", "choices", "default"), [group_row(path, files) for path, files in groups.items()]),
    ]
    parts += ["## Options of every run", "From `conf/config.yaml`.", options(CONF / "config.yaml", "")]
    for path, files in groups.items():
        parts += [f"## `{path.name}=`", *group_tables(path.name, files)]
    return "\n\n".join(parts) + "\n"


def group_row(path: Path, files: list[Path]) -> tuple[str, str, str, str]:
    names = [file.stem for file in files if file.stem != "base"]
    choices = ", ".join(f"`{name}`" for name in names) if len(names) < 20 else f"{len(names)} of them, see below"
    found = re.findall(rf"^  - {path.name}(?:@\w+)?: (\w+)", (CONF / "config.yaml").read_text(), re.MULTILINE)
    found = [overridden(CONF / "train" / "quick.yaml").get(path.name, choice) for choice in found]
    default = ", ".join(f"`{choice}`" for choice in found if choice != "null") or "none"
    return f"`{path.name}`", PURPOSE[path.name], choices, default


def group_tables(group: str, files: list[Path]) -> list[str]:
    """One table for the choices that have the same options; of a group with a base.yaml one of that, and one for each
    choice that names its own component and adds options."""
    alike: dict[tuple[str, ...], list[Path]] = {}
    bases = [file for file in files if file.stem == "base"]
    own = [file for file in files if len(rows := option_rows(file, "")) > 1 and rows[0][0] == "`name`"]
    for file in bases + own if bases else files:
        alike.setdefault(tuple(key for key, _, _ in option_rows(file, "")), []).append(file)
    parts = []
    for same in alike.values():
        prefix = package(group, same[0])
        parts.append("\n".join(f"- {name(group, file)}: {head(file)}{others(file)}" for file in same if head(file)))
        columns = [option_rows(file, prefix) for file in same]
        rows = [
            (row[0][0], *(value for _, value, _ in row), next((comment for _, _, comment in row if comment), ""))
            for row in zip(*columns, strict=True)
            if row[0][0] != f"`{MOUNTED.get(group, group)}.name`"
        ]
        if rows:
            parts.append(table(("option", *(f"`{file.stem}`" for file in same), "what it is"), rows))
        if same[0].stem == "base":
            rest = [file for file in files if head(file) and file not in [*same, *own]]
            parts.append("\n".join(f"- {name(group, file)}: {head(file)}" for file in rest))
    return [part for part in parts if part]


def package(group: str, file: Path) -> str:
    """What comes before the keys of a choice in the configuration, up to the dot."""
    said = re.search(r"^# @package (\w+)", file.read_text(), re.MULTILINE)
    mount = said[1] if said else MOUNTED.get(group, group)
    return "" if mount == "_global_" else f"{mount}."


def name(group: str, file: Path) -> str:
    return "all choices" if file.stem == "base" else f"`{group}={file.stem}`"


def overridden(file: Path) -> dict[str, str]:
    """The choices of other groups that a choice makes."""
    return dict(re.findall(r"^  - override /(\w+): (\w+)", file.read_text(), re.MULTILINE))


def others(file: Path) -> str:
    chosen = ", ".join(f"`{group}={choice}`" for group, choice in overridden(file).items())
    return f" It chooses {chosen}." if chosen else ""


def head(file: Path) -> str:
    """The comment at the top of a choice, or beside its name."""
    comments = itertools.takewhile(lambda line: line.startswith("#"), file.read_text().splitlines())
    text = " ".join(line[2:] for line in comments if not line.startswith(("# @package", "#   ")))
    return text or next((comment for key, _, comment in option_rows(file, "") if key == "`name`"), "")


def options(file: Path, prefix: str) -> str:
    return table(("option", "default", "what it is"), option_rows(file, prefix))


def option_rows(file: Path, prefix: str) -> list[tuple[str, str, str]]:
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
            rows.append((f"`{prefix}{'.'.join(parents)}`", shown, comment.replace("|", "\\|")))
    return rows


def table(header: tuple[str, ...], rows: list[tuple[str, ...]]) -> str:
    lines = [header, ("---",) * len(header), *rows]
    return "\n".join(f"| {' | '.join(cells)} |" for cells in lines)


def main() -> None:
    PAGE.write_text(PAGE.read_text().partition(MARK)[0] + MARK + "\n" + made())


if __name__ == "__main__":
    main()
