"""The notebooks run from top to bottom on a small store of several kinds of runs."""

import pytest

from tests.helpers.configs import ROOT

nbformat = pytest.importorskip("nbformat", reason="nbformat is not installed")
nbclient = pytest.importorskip("nbclient", reason="nbclient is not installed")

FOLDER = ROOT / "analysis" / "notebooks"
DRAWN = {"pandas": 1, "capacity": 2, "your_sweep": 2, "train": 1}
"""Notebook -> number of pictures in it."""


@pytest.mark.parametrize("name", DRAWN)
def test_a_notebook_runs_and_draws_its_pictures(name, mixed_store, monkeypatch):
    monkeypatch.setenv("QNERF_STORE", str(mixed_store))
    monkeypatch.setenv("QNERF_STEPS", "3")
    book = nbformat.read(FOLDER / f"{name}.ipynb", as_version=4)
    nbclient.NotebookClient(book, timeout=300, resources={"metadata": {"path": str(FOLDER)}}).execute()
    shown = [output.get("data", {}) for cell in book.cells for output in cell.get("outputs", [])]
    assert sum("image/png" in data for data in shown) == DRAWN[name]
