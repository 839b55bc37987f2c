"""Figures of what lies in a run's folder beside its numbers: pictures, and what `qnerf probe` wrote."""

import shutil
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from qnerf.analysis import figures
from qnerf.analysis.figures.__main__ import main
from qnerf.analysis.images import panels
from qnerf.analysis.load import runs

from qnerf.probes import PROBES, load, probe
from qnerf.probes.shots_and_noise import evaluate_hardware, grid


@pytest.fixture(scope="module")
def store(tmp_path_factory, trained):
    """A classical and a quantum configuration, two seeds each; one quantum run is probed, both were given shots."""
    folder = shutil.copytree(trained, tmp_path_factory.mktemp("files") / "runs")
    for path in runs(folder, "field=qcolor state=finished")["path"]:
        evaluate_hardware(load(Path(path)), grid([10, 100], "none", [], 0))
        evaluate_hardware(load(Path(path)), grid([], "depolarizing", [0.01, 0.1], 0))
    for name in PROBES:
        probe(load(Path(path)), name)
    return folder


@pytest.fixture
def frame(store):
    return runs(store, "state=finished")


@pytest.fixture
def probed(frame):
    return figures.best_of(frame, "units")


def footnote(figure) -> str:
    return " ".join(figure.get_supxlabel().split())


def test_the_grid_shows_the_stored_panels_of_median_runs(frame):
    chosen = figures.typical(frame)
    for _, row in chosen.iterrows():
        own = frame[frame["field"] == row["field"]]["psnr"]
        assert row["psnr"] == own.min()  # the lower of two is the median
    shown = figures.qualitative_panels(chosen)
    figure = figures.qualitative_grid(frame, views=1)
    drawn = [ax.images[0].get_array() for ax in figure.axes]
    assert len(drawn) == 4 * len(shown) == 8
    for number, picture in enumerate(shown["picture"]):
        for column, panel in enumerate(panels(picture).values()):
            np.testing.assert_array_equal(drawn[4 * number + column], panel)
    row = shown.iloc[0]
    measured = pd.read_parquet(row["picture"].parents[1] / "eval.parquet").set_index("image")["psnr"]
    assert row["psnr"] == pytest.approx(measured[f"images/{row['image'].removeprefix('images-')}.png"])
    assert figure.axes[1].get_xlabel() == f"{row['psnr']:.2f} dB"


def test_the_spectrum_shows_each_share_of_variance(probed):
    table = figures.spectrum_points(probed)
    assert table["share"].between(-1e-9, 1 + 1e-9).all()
    np.testing.assert_allclose(table.groupby(["circuit", "output", "wire"])["share"].sum(), 1)
    figure = figures.fourier_spectrum(probed)
    rows = table[(table["circuit"] == 0) & (table["frequency"] == 1)]
    expected = rows.pivot(index="output", columns="wire", values="share").to_numpy()
    drawn = np.ma.filled(figure.axes[0].images[0].get_array().astype(float), np.nan)
    shown = expected >= 1e-4
    np.testing.assert_allclose(drawn[shown], expected[shown])
    assert np.isnan(drawn[~shown]).all()
    heights = [patch.get_height() for patch in figure.axes[2].patches]
    first = table[(table["circuit"] == 0) & (table["frequency"] > 0)]
    shares = first.groupby("frequency")["share"].sum() / 9
    np.testing.assert_allclose(heights, [*shares, 1 - shares.sum()])
    assert footnote(figure).startswith("exact;")


@pytest.mark.parametrize(
    ("draw", "column", "asked"),
    [
        (figures.psnr_vs_shots, "shots", "noise == 'none' and shots > 0"),
        (figures.psnr_vs_noise, "p", "noise != 'none'"),
    ],
)
def test_psnr_under_hardware_conditions_is_the_mean_over_views_and_seeds(frame, draw, column, asked):
    paths = frame[frame["field"] == "qcolor"]["path"]
    measured = [pd.read_parquet(f"{path}/eval_hardware.parquet") for path in paths]
    means = [rows.query(asked).groupby(column)["psnr"].mean() for rows in measured]
    figure = draw(frame)
    (container,) = figure.axes[0].containers
    np.testing.assert_allclose(container[0].get_xdata(orig=False), means[0].index)
    np.testing.assert_allclose(container[0].get_ydata(orig=False), np.mean(means, axis=0))
    (dashed,) = [line for line in figure.axes[0].lines if line.get_linestyle() == "--"]
    exact = frame[frame["field"] == "qcolor"]["psnr"].mean()
    assert dashed.get_ydata()[0] == pytest.approx(exact, rel=1e-4)


def test_conditions_that_one_seed_lacks_are_not_averaged(frame, tmp_path):
    path = frame[frame["field"] == "qcolor"]["path"].iloc[0]
    rows = pd.read_parquet(f"{path}/eval_hardware.parquet")
    (tmp_path / "copy").mkdir()
    rows[rows["shots"] != 100].to_parquet(tmp_path / "copy" / "eval_hardware.parquet")
    figure = figures.psnr_vs_shots(frame.replace({"path": {path: str(tmp_path / "copy")}}))
    (container,) = figure.axes[0].containers
    assert container[0].get_xdata(orig=False).tolist() == [10]
    assert "not drawn: 1 conditions that some measured seeds lack" in footnote(figure)


def test_figures_say_how_to_make_what_is_missing(frame):
    classical = frame[frame["field"] == "classical"]
    with pytest.raises(ValueError, match=r"no run of 2 has units.parquet; `qnerf probe RUN units` writes it"):
        figures.best_of(classical, "units")
    with pytest.raises(ValueError, match=r"has no spectrum.parquet; `qnerf probe .* spectrum` writes it"):
        figures.fourier_spectrum(classical["path"].iloc[0])


def test_a_figure_asked_for_by_name_is_an_error_where_it_cannot_be_drawn(store, tmp_path):
    out = ["--out", str(tmp_path)]
    main([str(store), "capacity", *out, "--filter", "field=classical", "--formats", "png"])
    assert [path.name for path in tmp_path.iterdir()] == ["capacity.png"]
    with pytest.raises(ValueError, match=r"no two configurations differ in train\.steps alone"):
        main([str(store), "time", *out])
    with pytest.raises(ValueError, match="unknown figure 'hue'; known: capacity"):
        main([str(store), "hue", *out])
