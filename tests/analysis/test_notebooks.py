"""The notebooks run from top to bottom on a small store of real runs, and are kept without what they printed."""

import pytest

from tests.helpers.configs import ROOT
from tests.helpers.sweep import sweep

nbformat = pytest.importorskip("nbformat", reason="nbformat is not installed")
nbclient = pytest.importorskip("nbclient", reason="nbclient is not installed")

FOLDER = ROOT / "analysis" / "notebooks"
DRAWN = {"capacity": 2, "speed_error": 3, "hsv": 1, "your_sweep": 2}
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


def test_notebooks_are_valid_and_stored_without_outputs():
    stored = sorted(FOLDER.glob("*.ipynb"))
    assert [path.stem for path in stored] == sorted(DRAWN)
    for path in stored:
        book = nbformat.read(path, as_version=nbformat.NO_CONVERT)
        nbformat.validate(book)
        code = [cell for cell in book.cells if cell.cell_type == "code"]
        assert all(cell.outputs == [] and cell.execution_count is None for cell in code)
        assert len({cell.id for cell in book.cells}) == len(book.cells)
        assert path.read_text(encoding="utf-8") == nbformat.writes(book) + "\n"
