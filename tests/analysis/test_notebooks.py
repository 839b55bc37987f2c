"""The notebooks run from top to bottom on a small store of real runs, and are kept with what they showed."""

import re

import pandas as pd
import pytest
from qnerf.analysis.load import runs
from qnerf.analysis.report.tables import over_seeds, row_keys
from qnerf.analysis.selection import select
from qnerf.analysis.tables import smallest

from tests.helpers.configs import ROOT
from tests.helpers.sweep import sweep

nbformat = pytest.importorskip("nbformat", reason="nbformat is not installed")
nbclient = pytest.importorskip("nbclient", reason="nbclient is not installed")

FOLDER = ROOT / "analysis" / "notebooks"
DRAWN = {"pandas": 1, "capacity": 1, "speed_error": 3, "hsv": 1, "your_sweep": 2}
"""Notebook -> number of figures in it."""


@pytest.fixture(scope="module")
def store(tmp_path_factory):
    return sweep(tmp_path_factory.getbasetemp())


@pytest.mark.parametrize("name", DRAWN)
def test_a_notebook_runs_and_draws_its_figures(name, store, monkeypatch):
    monkeypatch.setenv("QNERF_STORE", str(store))
    book = nbformat.read(FOLDER / f"{name}.ipynb", as_version=4)
    nbclient.NotebookClient(book, timeout=300, resources={"metadata": {"path": str(FOLDER)}}).execute()
    shown = [output.get("data", {}) for cell in book.cells for output in cell.get("outputs", [])]
    assert sum("image/png" in data for data in shown) == DRAWN[name]
    assert any("qcolor" in str(data) for data in shown)


def test_notebooks_are_kept_as_they_ran():
    """So that they read on a hosting site: every cell executed in order, small pictures, no path of one machine."""
    stored = sorted(FOLDER.glob("*.ipynb"))
    assert [path.stem for path in stored] == sorted(DRAWN)
    for path in stored:
        book = nbformat.read(path, as_version=nbformat.NO_CONVERT)
        nbformat.validate(book)
        code = [cell for cell in book.cells if cell.cell_type == "code"]
        assert [cell.execution_count for cell in code] == list(range(1, len(code) + 1))
        kept = [output for cell in code for output in cell.outputs]
        assert not any(output.output_type == "error" or output.get("name") == "stderr" for output in kept)
        pictures = [output.data["image/png"] for output in kept if "image/png" in output.get("data", {})]
        assert len(pictures) == DRAWN[path.stem]
        assert all(len(picture) * 3 / 4 < 300_000 for picture in pictures)
        assert not re.search(r"/(home|root|tmp|Users)/", str(kept))
        assert len({cell.id for cell in book.cells}) == len(book.cells)
        assert path.read_text(encoding="utf-8") == nbformat.writes(book) + "\n"
        prose = "".join(cell.source for cell in book.cells if cell.cell_type == "markdown")
        assert all(part in prose for part in ("**Question.**", "**Seen here.**", "## What follows"))


def test_a_store_that_mixes_settings_ends_in_no_traceback(store):
    """Other steps in some runs: every notebook that compares configurations gives them rows of their own."""
    frame = runs(store)
    longer = frame.assign(**{"train.steps": frame["train.steps"] + 5, "run_id": frame["run_id"] + "x"})
    both = pd.concat([frame, longer], ignore_index=True)
    made = over_seeds(both)
    assert len(made.text) == 4
    assert len(smallest(both, row_keys(select(both).runs), size="params.color").text) == 1
