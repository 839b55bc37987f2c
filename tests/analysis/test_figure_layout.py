"""What a journal asks of every figure: legible texts that do not overlap, named axes, and a legend of what is drawn."""

import itertools

import numpy as np
import pandas as pd
import pytest
from matplotlib.axis import Tick
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import LineCollection
from matplotlib.text import Text
from qnerf.analysis import style
from qnerf.analysis.figures import FIGURES
from qnerf.analysis.load import runs
from qnerf.analysis.marks import Mark, write_names

from tests.helpers.configs import ROOT

PACKS = {
    "capacity": "seeds",
    "capacity_color": "small_heads",
    "capacity_density": "pe_widths",
    "speed": "rgb_table",
    "shots": "shots",
    "noise": "noise",
}
"""Figure -> a pack of real runs that it is drawn from."""


def boxes(figure) -> dict[Text, np.ndarray]:
    """Left, low, right and high end in pixels of each text that is seen."""
    figure.draw_without_rendering()
    renderer = FigureCanvasAgg(figure).get_renderer()
    axes = [axis for ax in figure.axes for axis in (ax.xaxis, ax.yaxis)]
    ticks = {label for axis in axes for tick in axis.findobj(Tick) for label in (tick.label1, tick.label2)}
    drawn = {tick.label1 for axis in axes if axis.axes.axison for tick in axis._update_ticks()}
    drawn |= {tick.label2 for axis in axes if axis.axes.axison for tick in axis._update_ticks()}
    texts = [text for text in figure.findobj(Text) if text.get_visible() and text.get_text().strip()]
    seen = [text for text in texts if text in drawn or text not in ticks]
    return {text: np.array(Text.get_window_extent(text, renderer).extents) for text in seen}


@pytest.mark.parametrize("name", PACKS)
def test_a_figure_can_be_printed_in_a_column(name):
    frame = runs(ROOT / "docs" / "results" / PACKS[name])
    figure = FIGURES[name].draw(frame)
    assert figure.get_figwidth() in (style.COLUMN, style.PAGE)
    texts = boxes(figure)
    assert min(text.get_fontsize() for text in texts) >= 6
    shown = list(texts.items())
    covered = [
        (one.get_text(), other.get_text())
        for (one, a), (other, b) in itertools.combinations(shown, 2)
        if (a[:2] + 1 < b[2:]).all() and (b[:2] + 1 < a[2:]).all()
    ]
    assert not covered
    width, height = figure.bbox.size
    outside = [text.get_text() for text, box in shown if box.min() < -1 or box[2] > width + 1 or box[3] > height + 1]
    assert not outside
    for ax in figure.axes:
        grid = ax.get_subplotspec()
        if ax.axison and grid is not None and grid.is_last_row():
            assert ax.get_xlabel(), f"{ax.get_title()}: the x axis has no name"
    for legend in figure.legends:
        assert not any(isinstance(handle, LineCollection) for handle in legend.legend_handles), "bars in the legend"
        entries = [text.get_text().replace("\n", " ") for text in legend.get_texts()]
        drawn = [label for ax in figure.axes for label in ax.get_legend_handles_labels()[1]]
        assert len(entries) == len(set(entries))
        assert set(entries) <= set(drawn)


def test_a_configuration_has_the_colour_of_its_field():
    looks = style.looks(["qcolor", "classical", "qcolor", "classical"])
    assert [(look["color"].upper(), look["marker"]) for look in looks[:2]] == [
        style.FIELDS["qcolor"],
        style.FIELDS["classical"],
    ]
    assert len({look["color"] for look in looks}) == 4
    assert looks[0]["marker"] != looks[2]["marker"]


def test_names_that_find_no_room_are_counted():
    figure = style.new(style.COLUMN, 2)
    ax = figure.subplots()
    marks = [
        Mark(ax, 1.0, float(number % 3), 1.0, f"a long name {number}").draw("o", color="k") for number in range(40)
    ]
    style.footnote(figure, "n = 3")
    write_names(figure, marks)
    texts = boxes(figure)
    names = [text for text in texts if text.get_text().startswith("a long name")]
    (note,) = [text.get_text() for text in texts if text.get_text().startswith("n = 3")]
    assert 0 < len(names) < 40
    assert f"marks without room for a name: {40 - len(names)}" in " ".join(note.split())


def test_figures_of_signals_count_the_head_that_they_have():
    frame = runs(ROOT / "docs" / "results" / "shots")
    signals = frame.assign(**{"params.density": np.nan, "params.color": np.nan, "params.head": 645.0})
    with pytest.raises(ValueError, match="no run has parameters of the colour head"):
        FIGURES["capacity_color"].draw(signals)
    drawn = FIGURES["capacity"].draw(signals).axes[0]
    assert {float(x) for mark in drawn.collections for x in pd.DataFrame(mark.get_offsets())[0]} >= {645.0}
