import pandas as pd
import pytest
from qnerf.analysis.figures.ladder import ladder_points, speed_error_ladder


@pytest.fixture
def results() -> pd.DataFrame:
    rows = [
        {"scene": scene, "kind": "trained", "rung": rung, "step_ms": step, "psnr": psnr + seed, "seed": seed}
        for scene in ("poster", "chair")
        for rung, step, psnr in (("full", 100.0, 25.0), ("auto", 40.0, 25.5))
        for seed in (0, 1)
    ]
    rows += [
        {"scene": "poster", "kind": "same weights", "rung": rung, "step_ms": step, "psnr": 25.0, "image_error": error}
        for rung, step, error in (("float64", 300.0, 0.0), ("compiled loops", 30.0, 1e-7), ("gate", 20.0, 1e-4))
    ]
    table = pd.DataFrame(rows)
    return table.assign(ssim=0.9, depth_error=float("nan"), parameters=1000)


def test_points_are_means_over_seeds_in_the_order_of_the_rungs(results: pd.DataFrame) -> None:
    table = ladder_points(results)
    assert table["rung"].tolist() == ["full", "auto", "full", "auto", "float64", "compiled loops", "gate"]
    auto = table.iloc[1]
    assert (auto["psnr"], auto["n"], auto["step_ms"]) == (26.0, 2, 40.0)
    assert auto["psnr_std"] == pytest.approx(0.5**0.5)


def test_the_figure_draws_what_was_trained_above_and_the_same_weights_below(results: pd.DataFrame) -> None:
    figure = speed_error_ladder(results)
    above, _, below, _ = figure.axes
    drawn = [tuple(float(v) for v in bars.lines[0].get_xydata()[0]) for bars in above.containers]
    assert drawn == [(100.0, 25.5), (40.0, 26.0)]
    assert [tuple(bars.lines[0].get_xydata()[0]) for bars in below.containers] == [(30.0, 1e-7), (20.0, 1e-4)]


def test_a_rung_looks_the_same_in_every_scene(results: pd.DataFrame) -> None:
    """Also where a scene lacks one that another has."""
    results = results[~((results["scene"] == "chair") & (results["rung"] == "full"))]
    figure = speed_error_ladder(results)
    looks = {}
    for ax in figure.axes[:2]:
        for handle, name in zip(*ax.get_legend_handles_labels(), strict=True):
            looks.setdefault(name, set()).add((handle.lines[0].get_marker(), handle.lines[0].get_color()))
    assert len(looks["auto"]) == 1
    assert looks["auto"] != looks["full"]
