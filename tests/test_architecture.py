"""ARCHITECTURE.md is true: rooms import downward only, and the picture names every room."""

import ast
import re

from tests.helpers.configs import ROOT

PACKAGE = ROOT / "src" / "qnerf"
BESIDE = ("analysis", "benchmarks")  # packages beside src/qnerf
DOORS = {"__init__.py", "__main__.py"}  # which import what they open
TOP = {*DOORS, "experiment.py", "metrics.py", "timing.py", "types.py"}


def floors():
    """The rooms of each floor in ARCHITECTURE.md, top floor first."""
    text = (ROOT / "ARCHITECTURE.md").read_text()
    picture = text.split("<!-- floors -->")[1].split("```")[1]
    return [re.split(r"\s{2,}", line) for line in picture.strip().splitlines()]


def rooms_of(line):
    """The names on a floor, without the description on its right."""
    return [name for name in line if name in ROOMS]


def room(module):
    """`qnerf.records.index` -> `records`; a module of `qnerf` itself is named by its file."""
    head, *rest = module.split(".")
    if head in BESIDE:
        return head
    if rest and rest[0] in BESIDE:  # qnerf.analysis
        return rest[0]
    return rest[0] if rest and (PACKAGE / rest[0]).is_dir() else f"{rest[0] if rest else '__init__'}.py"


ROOMS = {path.name for path in PACKAGE.iterdir() if path.is_dir() and (path / "__init__.py").exists()} | {
    *BESIDE,
    *(TOP - DOORS),
}


def imports(path):
    """Modules of qnerf that a file imports anywhere, also inside functions."""
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.ImportFrom) and node.level == 0 and (node.module or "").split(".")[0] == "qnerf":
            for alias in node.names:
                yield f"qnerf.{alias.name}" if node.module == "qnerf" else str(node.module)
        elif isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names if alias.name.startswith("qnerf."))


def arrows():
    """File, its room, and a room that it imports from."""
    for folder, package in [(PACKAGE, "qnerf"), *((ROOT / name, name) for name in BESIDE)]:
        for path in sorted(set(folder.rglob("*.py")) - {PACKAGE / name for name in DOORS}):
            own = room(".".join([package, *path.relative_to(folder).with_suffix("").parts]))
            for module in imports(path):
                other = room(module)
                if other in ROOMS and other != own:
                    yield str(path.relative_to(ROOT)), own, other


FLOORS = [rooms_of(line) for line in floors()]
LEVEL = {name: len(FLOORS) - floor for floor, names in enumerate(FLOORS) for name in names}


def test_the_picture_shows_every_room():
    assert set(LEVEL) == ROOMS


def test_the_package_itself_holds_a_handful_of_files():
    assert {path.name for path in PACKAGE.glob("*.py")} == TOP


def test_imports_go_down():
    upwards = [
        f"{file}: {own} may not import from {other}" for file, own, other in arrows() if LEVEL[own] <= LEVEL[other]
    ]
    assert upwards == []


def test_the_analysis_has_one_import_name():
    for folder in ("src", "analysis", "benchmarks", "tests"):
        for path in (ROOT / folder).rglob("*.py"):
            assert not re.search(r"^\s*(import|from) analysis\b", path.read_text(), re.MULTILINE), path


def test_the_library_never_imports_hydra():
    for path in PACKAGE.rglob("*.py"):
        if "cli" not in path.relative_to(PACKAGE).parts:
            assert not re.search(r"^\s*(import|from) hydra", path.read_text(), re.MULTILINE), path
