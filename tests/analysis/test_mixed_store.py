"""Fields, photographs, distances and tracked loops in one store go through every table, figure, page and command."""

import pytest
from qnerf.analysis import figures, load
from qnerf.analysis.figures.__main__ import main as draw
from qnerf.analysis.pack import main as pack
from qnerf.analysis.report import content, curves
from qnerf.analysis.report.__main__ import main as report
from qnerf.analysis.report.pictures import Pictures
from qnerf.analysis.report.tables import over_seeds
from qnerf.analysis.selection import row_keys
from qnerf.analysis.serve.answers import Answers
from qnerf.analysis.serve.store import WatchedStore
from qnerf.analysis.tables.__main__ import main as tables

from qnerf.cli.main import dispatch


def test_every_table(mixed_store, capsys):
    frame = load.runs(mixed_store)
    assert set(frame["scene_name"]) >= {"ring"}
    over = over_seeds(frame)
    assert len(over.text) >= 4  # two fields and two heads of a photograph; distances have no PSNR
    assert not any("nan" in cell for column in over.text for cell in over.text[column].astype(str))
    rows = ",".join(row_keys(frame[frame["state"] == "finished"]))
    for more in (["--stability"], ["--metric", "distance_error"], []):
        tables([str(mixed_store), "--rows", rows, *more])
        assert "|" in capsys.readouterr().out
    with pytest.raises(ValueError, match="probe RUN units"):
        tables([str(mixed_store), "--rows", rows, "--units"])


def test_every_figure(mixed_store, tmp_path, capsys):
    draw([str(mixed_store), "--out", str(tmp_path), "--formats", "png"])
    said = capsys.readouterr()
    drawn = {path.stem for path in tmp_path.glob("*.png")}
    assert "Error" not in said.out
    assert {"capacity", "loss", "speed", "qualitative"} <= {name.split("_")[0] for name in drawn}, said
    assert "forest" in drawn
    assert len(figures.capacity_points(load.runs(mixed_store))) == 4
    rungs, part = figures.stand_in_points(load.runs(mixed_store))
    assert (part, set(rungs["scene_name"])) == ("head", {"astronaut"})
    assert dict(zip(rungs["rung"], rungs["verdict"], strict=True)).get("1L1S", "circuit") == "circuit"


def test_every_page(mixed_store, tmp_path):
    report([str(mixed_store), "--out", str(tmp_path / "page.html")])
    assert (tmp_path / "page.html").stat().st_size > 10_000
    live = Answers(WatchedStore(mixed_store))
    assert live.page()["data"]["total"] == len(load.runs(mixed_store))
    assert live.differences("", "", "", "psnr").table
    pack([str(mixed_store), str(tmp_path / "packed")])
    assert len(load.runs(tmp_path / "packed")) == len(load.runs(mixed_store))
    with pytest.raises(ValueError, match="curves are not packed"):
        draw([str(tmp_path / "packed"), "loss", "--out", str(tmp_path)])


def test_tracked_runs_stand_beside_the_others(mixed_store, capsys):
    rows = ["--rows", "scene_name,field"]
    tables([str(mixed_store), *rows, "--filter", "scene_name=digits", "--baseline", "field=mine"])
    assert "better *" in capsys.readouterr().out
    tables([str(mixed_store), *rows, "--metric", "accuracy", "--resources"])
    run = load.runs(mixed_store, "scene_name=digits")["path"].iloc[0]
    for command in (["render"], ["export"], ["probe", "units"], ["reproduce"]):
        assert dispatch(command[0], [run, *command[1:]]) == 2
        assert "was trained by a loop of its own" in capsys.readouterr().err
    frame = content.prepared(load.runs(mixed_store, "scene_name=digits"))
    shown = content.data(frame, Pictures(), curves.gather(frame, range(len(frame))))
    assert shown["curve_names"] == {"loss": "loss"}
