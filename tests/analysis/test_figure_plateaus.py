"""The figure of vanishing gradients draws what its benchmark measured, and the benchmark measures what it says."""

import numpy as np
import pandas as pd
import pytest
import torch
from qnerf.analysis import figures

from benchmarks.plateaus import gradients, measure
from qnerf.quantum import statevector
from qnerf.quantum.circuit import ANSATZE
from qnerf.quantum.initial_angles import INITS
from qnerf.quantum.normal_form import normal_form


@pytest.fixture(scope="module")
def table() -> pd.DataFrame:
    return measure(wires=(2, 3, 4), depths=(1, 2), circuits=12)


def test_lines_and_bars_are_the_benchmark_s(table: pd.DataFrame, tmp_path) -> None:
    table.to_parquet(tmp_path / "plateaus.parquet")
    figure = figures.barren_plateaus(tmp_path / "plateaus.parquet")
    assert [ax.get_title() for ax in figure.axes] == ["init = eighth", "init = uniform"]
    for ax in figure.axes:
        own = table[table["init"] == ax.get_title().removeprefix("init = ")]
        assert [container.get_label() for container in ax.containers] == ["S = 1", "S = 2"]
        for spectral, container in zip((1, 2), ax.containers, strict=True):
            line, _, (bars,) = container
            expected = own[own["S"] == spectral]
            np.testing.assert_array_equal(line.get_xdata(), expected["wires"])
            np.testing.assert_array_equal(line.get_ydata(), expected["variance"])
            lengths = [segment[1, 1] - segment[0, 1] for segment in bars.get_segments()]
            np.testing.assert_allclose(lengths, 2 * expected["error"])
    assert figure.axes[0].get_yscale() == "log"
    assert "12 random circuits per point" in " ".join(figure.get_supxlabel().split())


def test_variances_are_those_of_parameter_shifts(table: pd.DataFrame) -> None:
    circuit = ANSATZE.build("qiren", 3, 2)
    form = normal_form(circuit)
    torch.manual_seed(3 * 1000 + 2)
    found = []
    for _ in range(12):
        w = INITS.get("uniform")(circuit).double()
        x = torch.randn(1, 3, dtype=torch.float64)
        turned = []
        for shift in (np.pi / 2, -np.pi / 2):
            moved = w.clone()
            moved[circuit.rows // 2, 0, 1] += shift
            turned.append(float(statevector.evaluate(form, x, moved)[0, 0]))
        found.append((turned[0] - turned[1]) / 2)
    row = table[(table["init"] == "uniform") & (table["wires"] == 3) & (table["S"] == 2)]
    squares = (np.array(found) - np.mean(found)) ** 2
    assert row["variance"].item() == pytest.approx(np.mean(squares), rel=1e-10)
    assert row["error"].item() == pytest.approx(np.std(squares, ddof=1) / np.sqrt(12), rel=1e-10)


def test_measuring_draws_nothing_from_the_caller_s_stream() -> None:
    torch.manual_seed(5)
    expected = torch.rand(3)
    torch.manual_seed(5)
    first = gradients("qiren", "uniform", 2, 1, 4)
    assert torch.equal(torch.rand(3), expected)
    assert torch.equal(gradients("qiren", "uniform", 2, 1, 4), first)


def test_without_a_benchmark_it_says_how_to_make_one(tmp_path) -> None:
    with pytest.raises(ValueError, match=r"no benchmark; `python -m benchmarks.plateaus` writes it"):
        figures.barren_plateaus(tmp_path / "none.parquet")
