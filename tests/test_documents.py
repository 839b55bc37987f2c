"""What documents tell a reader to type is understood, what they link to is there, what they quote is in its row."""

import re

import pandas as pd
import pytest
from qnerf.analysis import load
from qnerf.analysis.figures import FIGURES, cheapest, stand_in_points

from tests.helpers import commands, quotes
from tests.helpers.configs import ROOT

DOCUMENTS = [*sorted(ROOT.glob("*.md")), *sorted((ROOT / "docs").rglob("*.md"))]
HEADERS = [*sorted((ROOT / "conf").rglob("*.yaml")), *sorted((ROOT / "sweeps").glob("*.yaml"))]
GENERATED = ("results.md", "numerics.md", "CHANGELOG.md")
"""Made of measurements, or history: their numbers are not quoted from anywhere."""
QUOTING = [file for file in DOCUMENTS if file.name not in GENERATED and "results" not in file.parts]
PARTS = 4
"""Tests that share the commands, so that several processes take them."""


def shown():
    """Each command of the documents and of the headers of configurations, once."""
    files = [file for file in (*DOCUMENTS, *HEADERS) if file.name != "CHANGELOG.md"]
    found = {command for file in files for command in commands.shown(file)}
    return sorted(command for command in found if "plugins=[" not in command)  # tests/config/test_plugins.py runs those


def test_commands_of_every_kind_are_in_documents():
    for start in ("python -m src.run", "qnerf run", "qnerf ", "python -m benchmarks.", "pip"):
        assert sum(command.startswith(start) for command in shown()) > 3, start


@pytest.mark.parametrize("part", range(PARTS))
def test_commands_are_understood(part):
    for command in shown()[part::PARTS]:
        try:
            commands.check(command)
        except (Exception, SystemExit) as error:
            raise AssertionError(command) from error


def test_a_command_with_a_mistake_is_found():
    for command in (
        "python -m src.run field=nonsense",
        "python -m src.run qiren.layerz=2",
        "python -m src.run -cd sweeps -cn nonsense",
        "qnerf nonsense",
        "qnerf runs --nonsense",
        "qnerf show --config",
        "qnerf tables runs --rowz field",
        "qnerf figures runs --themes grey",
        "python -m benchmarks.nonsense",
        "python -m benchmarks.training --rounds many",
        'pip install "qnerf[nonsense]"',
    ):
        with pytest.raises((Exception, SystemExit)):
            commands.check(command)


def test_quoted_numbers_are_in_their_rows():
    wrong = {file.name: quotes.problems(file.read_text(), quotes.results()) for file in QUOTING}
    assert {name: problems for name, problems in wrong.items() if problems} == {}


def test_enough_numbers_have_a_row():
    comments = [comment for file in QUOTING for comment in quotes.COMMENT.findall(file.read_text())]
    assert sum(kind == "results" for kind, _ in comments) > 40


def test_a_test_that_a_document_relies_on_is_here():
    for file in QUOTING:
        for test in re.findall(r"checked by (\w+)", file.read_text()):
            assert test in globals(), test


PAGE = """\
| field | fox: PSNR, dB | room: PSNR, dB | fox: against classical | room: against classical | seeds |
|---|---|---|---|---|---|
| classical | **25.95 ± 0.33** | 27.16 ± 0.34 |  |  | 10 |
| qcolor | 24.71 ± 0.67 | 27.10 ± 0.48 | -1.24 ± 0.52 worse * | -0.06 ± 0.39 equivalent | 10 |
"""
PROSE = """\
It gives 24.71 ± 0.67 and 27.10 ± 0.48 dB <!-- results seeds: fox/room qcolor -->
and loses 1.24 ± 0.52 dB <!-- results seeds: fox classical - qcolor -->
or changes by -0.06 ± 0.39 dB. <!-- results seeds: room qcolor - classical -->

<!-- each row, results seeds: {1} {2} - classical -->
| scene | field | PSNR | difference |
|---|---|---|---|
| `fox` | `qcolor` | 24.71 ± 0.67 | -1.24 ± 0.52 |
| `room` | `qcolor` | 27.1 | -0.06 ± 0.39 |
"""


def test_quoted_numbers_in_their_rows_pass():
    assert quotes.problems(PROSE, {"seeds": quotes.measured(PAGE)}) == []


def test_quoted_numbers_in_wrong_rows_are_found():
    for one, other in (
        ("24.71 ± 0.67 and", "27.10 ± 0.48 and"),  # another row's
        ("changes by -0.06 ± 0.39", "changes by -1.24 ± 0.52"),
        ("24.71 ± 0.67 | -1.24 ± 0.52", "27.10 ± 0.48 | -0.06 ± 0.39"),  # a table's rows
        ("27.1 |", "27.4 |"),
        ("and 27.10 ± 0.48 dB", "dB"),  # a row without its number
        (" <!-- results seeds: room qcolor - classical -->", ""),  # no source
        ("results seeds: fox/room", "results sedes: fox/room"),
        ("room qcolor - classical", "room qcolor - qdensity"),
    ):
        assert PROSE.count(one) == 1, one
        assert quotes.problems(PROSE.replace(one, other), {"seeds": quotes.measured(PAGE)}), one


def test_the_tables_of_what_computing_less_costs():
    """Cell by cell, as the benchmark's committed measurements have them."""
    page = (ROOT / "docs" / "speed.md").read_text()
    table = pd.read_parquet(ROOT / "benchmarks" / "results" / "speed_error.parquet")
    groups = table.groupby(["scene", "kind", "rung"], sort=False)
    means = groups[["step_ms", "psnr", "image_error"]].mean()
    points = means.assign(psnr_std=groups["psnr"].std(), n=groups.size()).reset_index()
    for (_, rung), rows in points.groupby(["kind", "rung"], sort=False):
        cells = {row.scene: ladder_cell(row) for row in rows.itertuples()}
        assert "| " + " | ".join([rung, *(cells.get(scene, "") for scene in points["scene"].unique())]) + " |" in page


def ladder_cell(row):
    """Milliseconds a step, PSNR, and the picture's error where the weights are the same."""
    psnr = f"{row.psnr:.2f} ± {row.psnr_std:.2f}" if row.n > 1 else f"{row.psnr:.2f}"
    return f"{row.step_ms:.0f} ms, {psnr}" + (f", {row.image_error:.1e}" if row.kind == "same weights" else "")


def test_the_cheapest_stand_ins_of_a_circuit():
    """Not worse, with the least CPU time: as the figure of the packed ladders has them."""
    found = {}
    for pack in ("ladder", "ladder_density", "ladder_color"):
        table, _ = stand_in_points(load.runs(ROOT / "docs" / "results" / pack))
        found |= {(pack, scene): cheapest(own, "cpu_s").split(": ")[-1] for scene, own in table.groupby("scene_name")}
    assert found == {
        ("ladder", "astronaut"): "siren3x18",
        ("ladder", "camera"): "siren3x18",
        ("ladder_density", "fox_64"): "2x29",
        ("ladder_density", "poster"): "2x29",
        ("ladder_color", "fox_64"): "all undecided or worse",
        ("ladder_color", "poster"): "2x41",
    }


def test_links_of_documents_lead_somewhere():
    for file in DOCUMENTS:
        for target, _, anchor in re.findall(r"\]\(([^)#\s]*)(#([^)\s]+))?\)", file.read_text()):
            if "://" not in target:
                page = file.parent / target if target else file
                assert page.exists(), (file, target)
                assert not anchor or anchor in anchors(page), (file, f"{target}#{anchor}")


def anchors(page):
    """The headings of a document as its host links to them."""
    headings = re.findall(r"^#+ (.+)$", quotes.FENCE.sub("", page.read_text()), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).strip().replace(" ", "-") for heading in headings}


def test_every_page_is_in_the_index():
    index = (ROOT / "docs" / "README.md").read_text()
    for page in (ROOT / "docs").glob("*.md"):
        assert page.name == "README.md" or f"]({page.name})" in index, page.name


def test_every_sweep_and_every_figure_is_named():
    sweeps = (ROOT / "docs" / "sweeps.md").read_text()
    figures = (ROOT / "docs" / "analysis.md").read_text()
    for path in (ROOT / "sweeps").glob("*.yaml"):
        assert f"`{path.stem}`" in sweeps, path.stem
    assert [name for name in FIGURES if f"`{name}`" not in figures] == []


def test_every_group_of_the_configuration_is_named():
    page = (ROOT / "docs" / "configuration.md").read_text()
    assert [
        path.name for path in (ROOT / "conf").iterdir() if path.is_dir() and f"(../conf/{path.name})" not in page
    ] == ["hydra"]


def test_the_readme_is_short():
    text = re.sub(r"<!--.*?-->", "", (ROOT / "README.md").read_text(), flags=re.DOTALL)
    assert len(text.split()) <= 1100
    prose = re.sub(r"^```.*?^```|^    [^\n]*|^\|[^\n]*|`[^`]*`|\]\([^)]*\)", "", text, flags=re.DOTALL | re.MULTILINE)
    assert len(re.findall(r"\d[\d.,]*", prose)) <= 40
