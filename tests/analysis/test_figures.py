"""The numbers that figures of runs draw, on a small store of real runs."""

import numpy as np
import pandas as pd
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays
from matplotlib.collections import PathCollection
from qnerf.analysis import figures, style
from qnerf.analysis.figures import curves, points
from qnerf.analysis.load import metrics, runs

from qnerf.experiment import run
from tests.helpers.configs import TINY, composed
from tests.helpers.packed_stores import IDLE
from tests.helpers.scenes import write_scene

SMALL = (*TINY, "train.steps=4", "train.rays=8", "train.eval_every=2", "train.log_every=1", "device=cpu")
GRID = (
    *(("field=classical", f"color.mlp.layers={layers}", "color.mlp.width=8", "hash=C7") for layers in (2, 3)),
    ("field=classical", "color.mlp.layers=2", "color.mlp.width=8", "hash=C6"),
    ("field=qcolor", "qiren=1L1S", "qiren.qubits=2", "hash=C7"),
    ("field=qcolor", "qiren=2L1S", "qiren.qubits=2", "hash=C7"),
)


@pytest.fixture(scope="module")
def store(tmp_path_factory):
    """Five configurations, two seeds each, and the first ones of another scene with one seed."""
    folder = tmp_path_factory.mktemp("figures")
    scenes = [f"scene.path={write_scene(folder / name, width=width)}" for name, width in (("hall", 6), ("yard", 7))]
    for overrides in GRID:
        for seed in (0, 1):
            run(composed("scene=nerfstudio", scenes[0], f"store={folder / 'runs'}", f"seed={seed}", *overrides, *SMALL))
    run(composed("scene=nerfstudio", scenes[1], f"store={folder / 'runs'}", *GRID[0], *SMALL))
    return folder / "runs"


@pytest.fixture(scope="module")
def every(store):
    return runs(store)


@pytest.fixture
def frame(every):
    return every[every["scene_name"] == "hall"].reset_index(drop=True).assign(**IDLE)


def footnote(figure) -> str:
    return " ".join(figure.get_supxlabel().split())


def bars(ax) -> np.ndarray:
    """(bars, 2) low and high ends of all vertical error bars."""
    segments = [segment for container in ax.containers for lines in container[2] for segment in lines.get_segments()]
    return np.array([segment[:, 1] for segment in segments if segment.size and not np.isnan(segment).any()])


def marks(ax) -> tuple[np.ndarray, np.ndarray]:
    """Places (marks, 2) and colours of all marks."""
    drawn = [own for own in ax.collections if isinstance(own, PathCollection)]
    return tuple(
        np.concatenate(part) for part in zip(*((own.get_offsets(), own.get_array()) for own in drawn), strict=True)
    )


def test_capacity_draws_mean_and_spread_over_seeds_by_kind(frame):
    figure = figures.capacity_vs_psnr(frame, "color")
    quantum, classical, _ = figure.axes
    for ax, field in ((quantum, "qcolor"), (classical, "classical")):
        own = frame[frame["field"] == field]
        keys = ["color.mlp.layers", "color.mlp.width", "hash"] if field == "classical" else ["color.qiren.layers"]
        groups = own.groupby(keys)
        expected = np.stack([groups["params.color"].first(), groups["psnr"].mean()], axis=1)
        drawn, ssim = marks(ax)
        np.testing.assert_allclose(sorted(drawn.tolist()), sorted(expected.tolist()))
        np.testing.assert_allclose(sorted(ssim), sorted(groups["ssim"].mean()))
        spread = np.diff(bars(ax)).ravel()
        np.testing.assert_allclose(sorted(spread), sorted(2 * groups["psnr"].std()))
        assert field.replace("qcolor", "quantum") in ax.get_title()
    assert footnote(figure).startswith("bars: ± standard deviation over seeds, n = 2; ")


def test_figures_of_one_seed_draw_no_bar_and_say_so(frame):
    figure = figures.capacity_vs_psnr(frame[frame["seed"] == 0])
    assert len(bars(figure.axes[1])) == 0
    assert "n = 1 seed: no bars" in footnote(figure)


def test_runs_that_cannot_count_are_counted(frame):
    spoiled = frame.copy()
    spoiled.loc[0, "state"], spoiled.loc[1, "state"], spoiled.loc[2, "psnr"] = "interrupted", "failed", np.nan
    table = figures.capacity_points(spoiled)
    assert table["n"].sum() == len(frame) - 3
    figure = figures.capacity_vs_psnr(spoiled)
    for reason in ("1 interrupted", "1 failed", "1 NaN psnr"):
        assert reason in footnote(figure)
    assert "n = 1 to 2" in footnote(figure)


def test_scenes_are_never_averaged(every):
    table = figures.capacity_points(every)
    (yard,) = table[table["scene_name"] == "yard"]["n"]
    assert yard == 1
    figure = figures.capacity_vs_psnr(every)
    assert [ax.get_title() for ax in figure.axes[:4]] == [
        f"{scene}: {kind}" for scene in ("hall", "yard") for kind in ("quantum", "classical")
    ]


def test_loss_curves_are_geometric_means_over_seeds(frame):
    own = frame[(frame["color.mlp.layers"] == 3) & (frame["field"] == "classical")]
    table = figures.loss_points(own)
    logged = [metrics(path, "train/mse").set_index("step")["value"] for path in own["path"]]
    decibels = np.log10(pd.concat(logged, axis=1))
    train = table[table["split"] == "train"].set_index("step")
    np.testing.assert_allclose(train["mse"], 10 ** decibels.mean(axis=1))
    np.testing.assert_allclose(train["mse_high"] / train["mse"], 10 ** decibels.std(axis=1))
    held_out = table[table["split"] == "eval"].set_index("step")
    final = own["psnr"].mean()
    assert held_out.loc[4, "mse"] == pytest.approx(10 ** (-final / 10))
    assert held_out.index.tolist() == [2, 4]
    lines = {line.get_label(): line for line in figures.loss_curves(own).axes[0].lines}
    np.testing.assert_allclose(lines["classical"].get_ydata(), held_out["mse"])


def test_octaves_are_geometric_means_over_seeds_against_steps_and_cpu_seconds(frame):
    own = frame[(frame["color.mlp.layers"] == 3) & (frame["field"] == "classical")]
    table = figures.octave_points(own)
    logged = [metrics(path, "eval/error_octave_1").set_index("step")["value"] for path in own["path"]]
    first = table[table["octave"] == 1].set_index("step")
    np.testing.assert_allclose(first["error"], np.sqrt(logged[0] * logged[1]))
    np.testing.assert_allclose(first["cpu_s"], first.index * own["step_cpu_ms"].mean() / 1000)
    steps, seconds = np.split(np.array(figures.octave_errors(own).axes), 2)
    assert len(steps) == table["octave"].nunique()
    for ax, x in ((steps[0], first.index), (seconds[0], first["cpu_s"])):
        (line,) = ax.lines
        np.testing.assert_allclose(line.get_xydata(), np.stack([x, first["error"]], 1))


def test_long_training_curves_are_means_of_spans():
    logged = pd.DataFrame({"step": np.arange(1, 1001), "time_s": 0.0, "value": np.arange(1000.0)})
    binned, shorter = figures.curves._binned([logged, logged[:510]])
    assert len(binned) == figures.curves.BINS
    assert binned["step"].iloc[0] == 20
    assert binned["value"].iloc[0] == np.arange(20).mean()
    assert shorter["step"].tolist() == binned["step"][:26].tolist()


def test_a_curve_ends_where_the_first_of_its_seeds_does():
    """With `stop.every` seeds end at steps of their own; the mean of fewer would jump there."""
    seeds = [pd.DataFrame({"step": [2, 4, last], "value": [1.0, 2.0, 3.0 * last]}) for last in (5, 6)]
    table = figures.curves._over_seeds(seeds)
    assert table["step"].tolist() == [2, 4]
    assert table["n"].tolist() == [2, 2]


def lengths(frame: pd.DataFrame) -> pd.DataFrame:
    """The same runs again, twice as long and a decibel better."""
    twice = {name: 2 * frame[name] for name in ("train.steps", "train_s")}
    return pd.concat([frame, frame.assign(**twice, psnr=frame["psnr"] + 1)], ignore_index=True)


def test_psnr_against_time_joins_trainings_of_different_lengths(frame):
    own = frame[frame["color.qiren.layers"].eq(2) & frame["field"].eq("qcolor")]
    (container,) = figures.psnr_vs_time(lengths(own)).axes[0].containers
    seconds, psnr = own["train_s"].mean(), own["psnr"].mean()
    np.testing.assert_allclose(container[0].get_xdata(orig=False), [seconds, 2 * seconds])
    np.testing.assert_allclose(container[0].get_ydata(orig=False), [psnr, psnr + 1])
    assert len(figures.psnr_vs_time(lengths(frame)).axes[0].containers) == len(GRID)
    with pytest.raises(ValueError, match="no two configurations differ in train\\.steps alone"):
        figures.psnr_vs_time(frame)


def test_configurations_beyond_the_best_are_told(frame):
    figure = figures.loss_curves(frame, most=2)
    best = frame.groupby(["field", "color", "hash"])["psnr"].mean().nlargest(2)
    drawn = [line.get_ydata()[-1] for line in figure.axes[0].lines if line.get_linestyle() == "--"]
    np.testing.assert_allclose(-10 * np.log10(drawn), best)
    assert "not drawn: 3 configurations of worse PSNR" in footnote(figure)


def test_the_pareto_front_is_drawn_and_named(frame):
    figure = figures.speed_vs_error(frame, "train_s")
    ax = figure.axes[0]
    table = figures.speed_points(frame, "train_s")
    on = table[table["front"]].sort_values("train_s")
    (step,) = [line for line in ax.lines if line.get_drawstyle() == "steps-post"]
    np.testing.assert_allclose(step.get_xydata(), on[["train_s", "psnr"]])
    assert step.get_ydata()[-1] == table["psnr"].max()
    assert step.get_xdata()[0] == table["train_s"].min()
    named = {text.get_text(): text.xy for text in ax.texts}
    front = {tuple(place) for place in on[["train_s", "psnr"]].to_numpy()}
    assert set(named.values()) == front or "marks without room for a name" in footnote(figure)
    assert set(named.values()) <= front
    with pytest.raises(ValueError, match="unknown cost 'hours'; known: step_ms, step_cpu_ms, train_s, "):
        figures.speed_vs_error(frame, "hours")


def test_times_of_two_machines_have_no_front(frame):
    frame.loc[0, "machine"] = "another"
    figure = figures.speed_vs_error(frame)
    assert not figures.speed_points(frame)["front"].any()
    assert not [text for ax in figure.axes for text in ax.texts]
    assert "time of a step is not ranked: measured on 2 machines" in footnote(figure)
    assert "training time is not ranked" in footnote(figures.psnr_vs_time(lengths(frame)))


@given(arrays.arrays(float, st.tuples(st.integers(1, 12), st.just(2)), elements=st.integers(0, 5).map(float)))
def test_the_front_holds_exactly_what_nothing_beats(values):
    table = pd.DataFrame(values, columns=["cost", "loss"])
    on = figures.front(table["cost"], table["loss"])
    for index, row in table.iterrows():
        beaten = ((table <= row).all(axis=1) & (table < row).any(axis=1)).any()
        assert on[index] == (not beaten)


def test_names_tell_every_configuration_apart(frame):
    table = points.points(frame.assign(**{"train.lr": frame["train.lr"]}), ["psnr"])
    assert table["name"].is_unique
    tuned = frame[(frame["hash"] == "C6")]
    both = pd.concat([tuned, tuned.assign(**{"train.lr": 0.5})], ignore_index=True)
    assert sorted(points.points(both, ["psnr"])["name"]) == ["classical, train.lr=0.01", "classical, train.lr=0.5"]
    both.loc[both["train.lr"] == 0.5, "train.eps"] = 1.0
    assert "classical, train.eps=1, train.lr=0.5" in map(_sorted_settings, points.points(both, ["psnr"])["name"])


def _sorted_settings(name):
    """Columns come in any order."""
    first, *settings = name.split(", ")
    return ", ".join([first, *sorted(settings)])


def test_saved_files_hold_text_and_never_change(frame, tmp_path):
    for name in ("first", "second"):
        style.save(figures.capacity_vs_psnr(frame), tmp_path / name)
    for kind in style.FORMATS:
        first, second = ((tmp_path / f"{name}.{kind}").read_bytes() for name in ("first", "second"))
        assert first == second
    assert ">C7 2x8</text>" in (tmp_path / "first.svg").read_text()
    assert b"/FontFile2" in (tmp_path / "first.pdf").read_bytes()


def test_a_short_logarithmic_axis_has_ticks_at_equal_steps():
    ax = style.new(style.COLUMN, 2).subplots()
    ax.set(xscale="log", xlim=(800, 1400))
    style.plain_ticks(ax)
    shown = [tick for tick in ax.get_xticks() if 800 <= tick <= 1400]
    assert len(shown) >= 3
    assert np.allclose(np.diff(shown), shown[1] - shown[0])


def test_a_seed_that_logs_a_step_twice_counts_once():
    rows = {"time_s": 1.0, "value": 20.0}
    once = pd.DataFrame([rows | {"step": step} for step in (10, 20)])
    twice = pd.concat([once, pd.DataFrame([rows | {"step": 20, "value": 30.0}])])
    table = curves._over_seeds([once, twice, once[:1]])
    assert table[["step", "n", "value"]].to_numpy().tolist() == [[10, 3, 20]]
    assert curves._over_seeds([once, twice])["value"].tolist() == [20, 25]


def test_legend_shows_names_that_begin_with_an_underscore():
    @style.styled
    def draw():
        figure = style.new(4, 3)
        ax = figure.subplots()
        for name in ("_mine", "plain"):
            ax.errorbar([1], [1], [1], label=name)
            ax.fill_between([1], [0], [1])
        style.legend(figure)
        return figure

    assert [text.get_text() for text in draw().legends[0].get_texts()] == ["_mine", "plain"]
