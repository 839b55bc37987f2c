import io
import re

import numpy as np
import pandas as pd
import pytest
from hypothesis import given
from hypothesis import strategies as st
from qnerf.analysis.load import runs
from qnerf.analysis.tables import Table, ablation, across_scenes
from qnerf.analysis.tables.__main__ import main
from qnerf.analysis.tables.ablation import best
from qnerf.analysis.tables.table import latex_escape, markdown_escape
from qnerf.analysis.tables.terminal import print_aligned
from rich.console import Console
from rich.text import Text
from scipy import stats

from tests.helpers.packed_stores import write_run


@pytest.fixture
def store(tmp_path):
    for field, level in (("classical", 20.0), ("qcolor", 21.0)):
        for seed in (0, 1, 2):
            write_run(tmp_path, field, seed, [level + seed, level + 2 * seed])
    return tmp_path


def test_means_spreads_and_counts_are_those_of_the_runs(store):
    made = ablation(runs(store), ["field", "color"])
    table = made.data
    row = table.loc[("qcolor", "1L2S")]
    by_hand = [21.0, 22.5, 24.0]
    assert row["psnr"].tolist() == pytest.approx([np.mean(by_hand), np.std(by_hand, ddof=1), 3])
    assert row[("ssim", "mean")] == pytest.approx(np.mean(by_hand) / 40)
    assert row[("seeds", "n")] == 3
    assert row[("params.color", "mean")] == 491
    lines = made.markdown().splitlines()
    assert lines[0].startswith("| field | color | PSNR, dB | seeds | SSIM | encoder parameters |")
    assert lines[2].startswith("| classical | 3x64 | 21.50 ± 1.50 |")
    assert lines[3].startswith("| qcolor | 1L2S | **22.50 ± 1.50** |")
    assert lines[3].endswith("| 394,929 | 11.0 ± 1.0 | 5 ± 0 |")
    assert "| 393,216 | 1,222 | 491 |" in lines[3]


def test_a_row_has_its_verdict_against_the_baseline(store):
    table = ablation(runs(store), ["field"], baseline={"field": "classical"})
    difference = table.data["difference"]
    reach = stats.t.ppf(0.975, 4) * np.sqrt(2 * 1.5**2 / 3)  # both have seeds at 20, 21.5, 23 dB, or 1 dB more
    assert difference.loc["qcolor", ["difference", "reach"]].tolist() == pytest.approx([1, reach])
    assert difference.loc["classical"].isna().all()
    assert table.text["difference, PSNR, dB"].tolist() == ["", f"+1.00 ± {reach:.2f}"]
    assert table.text["verdict"].tolist() == ["", "undecided"]
    assert table.notes[0].endswith(
        "equivalent: the 90 % interval is within ± 0.5 dB; * holds for all rows together; no registered study"
    )
    assert ablation(runs(store), ["field"], baseline="field=classical", within=5).text["verdict"][1] == "equivalent *"


def test_ablation_of_one_seed_has_no_spread_and_says_so(store):
    frame = runs(store)
    table = ablation(frame[frame["seed"] == 0], ["field"], baseline={"field": "classical"})
    assert "±" not in table.text.to_string()
    assert table.text["seeds"].tolist() == ["1", "1"]
    assert "n = 1 in 2 of 2 rows: no spread" in table.notes
    assert table.text["difference, PSNR, dB"][1] == "+1.00 (one seed)"
    assert table.text["verdict"][1] == "undecided"


def test_runs_that_are_left_out_are_counted_with_the_reason(store):
    write_run(store, "classical", 3, state="failed")
    write_run(store, "classical", 4, state="interrupted")
    write_run(store, "classical", 5, state="interrupted")
    write_run(store, "qcolor", 3, [float("nan"), 20.0])
    write_run(store, "qcolor", 4, [float("inf"), 20.0])
    damaged = write_run(store, "qcolor", 5)
    (damaged / "summary.parquet").write_bytes(b"")
    table = ablation(runs(store), ["field"])
    (note,) = [note for note in table.notes if note.startswith("left out: ")]
    assert set(note.removeprefix("left out: ").split(", ")) == {
        "1 failed",
        "2 interrupted",
        "1 damaged",
        "1 NaN psnr",
        "1 infinite psnr",
    }
    assert table.data[("psnr", "mean")].tolist() == pytest.approx([21.5, 22.5])


def test_a_value_that_only_some_seeds_have_says_how_many(store):
    write_run(store, "qcolor", 3, results={"lpips": 0.5})
    write_run(store, "qcolor", 4, results={"lpips": 0.7})
    table = ablation(runs(store), ["field"])
    assert table.text["LPIPS"].tolist() == ["", "0.6000 ± 0.1414 (n = 2)"]


def test_ablation_refuses_what_must_not_be_averaged(store):
    frame = runs(store)
    with pytest.raises(ValueError, match=r"row poster mixes runs of different field \(classical, qcolor\)"):
        ablation(frame, ["scene_name"])
    write_run(store, "qcolor", 3, config={"train": {"steps": 20}})
    with pytest.raises(ValueError, match=r"row qcolor mixes runs of different train.steps \(10, 20\)"):
        ablation(runs(store), ["field"])
    assert len(ablation(runs(store), ["field", "train.steps"]).data) == 3


def test_scenes_stand_in_one_table_only_under_their_names(store):
    write_run(store, "classical", 0, [30.0], scene="chair")
    frame = runs(store)
    with pytest.raises(ValueError, match=r"2 scenes in one table \(chair, poster\): add scene_name"):
        ablation(frame[(frame["field"] == "qcolor") | (frame["scene_name"] == "chair")], ["field"])
    table = ablation(frame, ["scene_name", "field"])
    assert table.text["scene_name"].tolist() == ["chair", "poster", "poster"]
    # The best of each scene; alone in its scene, a row is no best.
    assert table.bold["PSNR, dB"].tolist() == [False, False, True]


def test_a_scene_without_the_baseline_is_noted(store):
    write_run(store, "qcolor", 0, [30.0], scene="chair")
    table = ablation(runs(store), ["scene_name", "field"], baseline={"field": "classical"})
    assert "no baseline in chair" in table.notes
    difference = table.text.set_index(["scene_name", "field"])["difference, PSNR, dB"]
    assert difference["chair", "qcolor"] == difference["poster", "classical"] == ""
    assert "±" in difference["poster", "qcolor"]


def test_scenes_are_judged_one_by_one_and_together(tmp_path):
    for scene, gain in (("fox", 1.0), ("poster", 0.9), ("room", 1.1)):
        for seed in range(3):
            write_run(tmp_path, "classical", seed, [20.0 + 0.1 * seed], scene=scene)
            write_run(tmp_path, "qcolor", seed, [20.0 + gain + 0.1 * seed], scene=scene)
    frame = runs(tmp_path)
    table = across_scenes(frame, ["scene_name", "field"], "field=classical")
    assert table.text["scene"].tolist() == ["fox", "poster", "room", "mean of these 3", "scenes like them"]
    assert table.text["verdict"].str.startswith("better").all()
    assert table.data["difference"].tolist() == pytest.approx([1, 0.9, 1.1, 1, 1])
    assert "qcolor: better on 3" in table.notes
    with pytest.raises(ValueError, match="expected scene_name and a key"):
        across_scenes(frame, ["field"], "field=classical")


def test_ablation_names_mistakes_in_what_is_asked_for(store, tmp_path):
    frame = runs(store)
    for message, call in {
        r"no run has a column 'colour'; did you mean color": lambda: ablation(frame, ["colour"]),
        r"no finished runs among 6: \{'failed': 6\}": lambda: ablation(frame.assign(state="failed"), ["field"]),
        r"no finished run of 6 has lpips; have: .*psnr, ssim": lambda: ablation(frame, ["field"], metric="lpips"),
        r"no metric 'beauty'; the runs have .*psnr": lambda: ablation(frame, ["field"], values=["beauty"]),
        r"no metric 'color'": lambda: ablation(frame, ["field"], metric="color"),
        r"'seed' is not a row key; the rows are field": lambda: ablation(frame, ["field"], baseline={"seed": 0}),
        r"expected one row of the table that matches, got 2: 2x64, classical; 2x64, qcolor": lambda: ablation(
            frame, ["density", "field"], baseline={"density": "2x64"}
        ),
        r"step_ms is not measured for each view": lambda: ablation(
            frame, ["field"], metric="step_ms", baseline={"field": "qcolor"}
        ),
    }.items():
        with pytest.raises(ValueError, match=message):
            call()


def test_a_table_is_the_same_in_every_format(store):
    table = ablation(runs(store), ["field"], values=["psnr", "params.color"], baseline={"field": "classical"})
    numbers = pd.read_csv(io.StringIO(table.csv()), index_col="field")
    assert numbers["psnr_mean"].tolist() == pytest.approx([21.5, 22.5])
    assert numbers["psnr_std"].tolist() == pytest.approx([1.5, 1.5])
    assert numbers.loc["qcolor", "difference_difference"] == pytest.approx(1)
    latex = table.latex().splitlines()
    assert [line for line in latex if line.startswith("\\") and "rule" in line] == [
        r"\toprule",
        r"\midrule",
        r"\bottomrule",
    ]
    assert r"qcolor & \textbf{22.50 $\pm$ 1.50} & +1.00 $\pm$ 3.40 & undecided & 3 & 491 \\" in latex
    assert r"\begin{tabular}{lrrlrr}" in latex
    assert r"\label{tab:psnr-db-over-seeds}" in latex
    assert "| qcolor | **22.50 ± 1.50** | +1.00 ± 3.40 | undecided | 3 | 491 |" in table.markdown()


def test_a_terminal_gets_an_aligned_table_of_the_metrics_that_fit(store):
    table = ablation(runs(store), ["field"], baseline={"field": "classical"})
    wide, narrow = (Console(file=io.StringIO(), width=width, force_terminal=True) for width in (400, 90))
    print_aligned(table, wide)
    print_aligned(table, narrow)
    every, some = (Text.from_ansi(console.file.getvalue()).plain.splitlines() for console in (wide, narrow))
    assert all(name in every[0] for name in table.text.columns)
    assert not any(line.startswith("left out, because") for line in every)
    for name in ("field", "PSNR, dB", "difference, PSNR, dB", "verdict", "seeds"):
        assert name in some[0]
    assert max(map(len, some)) <= 90
    (note,) = [line for line in some if line.startswith("left out, because the terminal is narrow: ")]
    assert "time of a step" in " ".join(some[some.index(note) :])


def test_latex_has_minus_signs_grouped_heads_and_no_empty_columns():
    text = pd.DataFrame(
        {
            "row": ["2020-01-02", "3x64"],
            "LPIPS": ["", ""],
            "PSNR, dB: paper": ["-1.5", "30"],
            "PSNR, dB: ours": ["-0.52 [-1.00, -.04]", "1e-06"],
            "note: one": ["a-1", "b"],
        }
    )
    lines = Table("A title", text, text, text == "nothing").latex().splitlines()
    head = lines[lines.index(r"\toprule") + 1 : lines.index(r"\bottomrule")]
    assert head == [
        r" & \multicolumn{2}{c}{PSNR, dB} &  \\",
        r"row & paper & ours & note: one \\",
        r"\midrule",
        r"2020-01-02 & $-$1.5 & $-$0.52 {[}$-$1.00, $-$.04{]} & a-1 \\",
        r"3x64 & 30 & 1e-06 & b \\",
    ]
    assert r"\label{tab:a-title}" in lines


SPECIAL = st.text(alphabet="ab \\{}$&#_%~^<>|[]*`±\n", max_size=12)


@given(SPECIAL)
def test_tables_escape_text_from_outside(text):
    frame = pd.DataFrame({"name": [text], "next": ["x"]})
    table = Table(text, frame, frame, frame == "nothing", (text,))
    cells = [line for line in table.latex().splitlines() if line.endswith(r"& x \\")]
    assert len(cells) == 1
    commands = r"\\textbackslash\{\}|\\text[a-z]+\{\}|\$\\pm\$|\\[{}$&#_%]|\{[\[\]*]\}"
    assert not set(re.sub(commands, "", latex_escape(text))) & set("\\{}$&#_%~^<>|[]*\n")
    row = table.markdown().splitlines()[2]
    assert len(re.findall(r"(?<!\\)(?:\\\\)*\|", row)) == 3


def test_a_star_in_a_name_is_no_emphasis_and_a_tag_is_text():
    assert markdown_escape("a*b* <b> p < 1 *") == r"a\*b\* \<b> p < 1 *"


@given(st.lists(st.floats(0, 50), min_size=2, max_size=6), st.sampled_from(["psnr", "lpips"]))
def test_bold_is_what_prints_like_the_best(means, name):
    table = pd.DataFrame({(name, "mean"): means}, index=pd.Index(range(len(means)), name="row"))
    bold = best(table, name).to_numpy()
    wanted = (np.argmax if name == "psnr" else np.argmin)(means)
    digits = 2 if name == "psnr" else 4
    if len({f"{mean:.{digits}f}" for mean in means}) == 1:
        assert not bold.any()
        return
    assert bold[wanted]
    assert {f"{means[row]:.{digits}f}" for row in np.flatnonzero(bold)} == {f"{means[wanted]:.{digits}f}"}


def test_tables_prints_what_is_asked_for(store, capsys):
    main([str(store), "--rows", "field", "--filter", "seed=1", "--values", "psnr"])
    assert capsys.readouterr().out.splitlines()[2:4] == ["| classical | 21.50 | 1 |", "| qcolor | **22.50** | 1 |"]
    main([str(store), "--rows", "field", "--baseline", "field=classical", "--format", "csv"])
    out, err = capsys.readouterr()
    assert out.startswith("field,psnr_mean,psnr_std,psnr_n")
    assert err.startswith("difference from classical")
    with pytest.raises(ValueError, match="baseline: 'run_id' is not a row key"):
        main([str(store), "--rows", "field", "--baseline", "seed"])


def test_a_mixture_in_a_row_without_a_value_is_named(store):
    frame = runs(store).assign(note=np.nan)
    with pytest.raises(ValueError, match="row none mixes runs of different field"):
        ablation(frame, ["note"])
