"""The figure of vanishing gradients draws its table."""

import numpy as np
from qnerf.analysis import figures


def test_lines_and_bars_are_those_of_the_table() -> None:
    table = figures.plateau_points()
    figure = figures.barren_plateaus()
    assert [ax.get_title() for ax in figure.axes] == ["init = eighth", "init = uniform"]
    for ax in figure.axes:
        own = table[table["init"] == ax.get_title().removeprefix("init = ")]
        depths = sorted(own["S"].unique())
        assert [container.get_label() for container in ax.containers] == [f"S = {depth}" for depth in depths]
        for spectral, container in zip(depths, ax.containers, strict=True):
            line, _, (bars,) = container
            expected = own[own["S"] == spectral]
            np.testing.assert_array_equal(line.get_xdata(), expected["wires"])
            np.testing.assert_array_equal(line.get_ydata(), expected["variance"])
            lengths = [segment[1, 1] - segment[0, 1] for segment in bars.get_segments()]
            np.testing.assert_allclose(lengths, 2 * expected["error"])
    assert figure.axes[0].get_yscale() == "log"
