"""One damaged run in a store: one row with its reason, and every other run is read as if nothing had happened."""

import io
import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from PIL import Image
from qnerf.analysis import images, load, packed
from qnerf.analysis.figures.files import draw
from qnerf.analysis.report import content, pictures
from qnerf.analysis.tables import ablation

from qnerf.records import StoreError, details
from tests.helpers.packed_stores import picture, write_run


@pytest.fixture
def store(tmp_path: Path) -> Path:
    panels = [np.full((4, 6, 3), shade, np.uint8) for shade in (50, 60, 70, 80)]
    for field in ("classical", "qcolor"):
        for seed in range(2):
            write_run(tmp_path / "runs", field, seed, pictures={"0": picture(*panels), "1": picture(*panels)})
    return tmp_path / "runs"


@pytest.fixture
def bad(store: Path) -> Path:
    return store / "poster-qcolor-s1"


def change_summary(run: Path, **columns: pa.Array) -> None:
    table = pq.read_table(run / "summary.parquet")
    for name, column in columns.items():
        if name in table.schema.names:
            table = table.drop_columns([name])
        table = table.append_column(name, column)
    pq.write_table(table, run / "summary.parquet")


DAMAGE: dict[str, tuple[Callable[[Path], None], str]] = {
    "time out of range": (
        lambda run: change_summary(run, psnr=pa.array([2**62], pa.timestamp("us"))),
        "Unsupported cast from timestamp",
    ),
    "text for a count": (
        lambda run: change_summary(run, **{"params.color": pa.array(["many"])}),
        "Failed to parse string: 'many'",
    ),
    "text for a seed": (lambda run: change_summary(run, seed=pa.array(["x"])), "Failed to parse string: 'x'"),
    "nested": (lambda run: change_summary(run, more=pa.array([[1]])), "damaged"),
    "no object": (lambda run: (run / "status.json").write_text("[1]") and None, "expected an object"),
}


@pytest.mark.parametrize("damage", DAMAGE)
def test_a_damaged_run_is_one_damaged_row(store: Path, bad: Path, damage: str) -> None:
    spoil, reason = DAMAGE[damage]
    spoil(bad)
    frame = load.runs(store).set_index("run_id")
    assert frame["state"].value_counts().to_dict() == {"finished": 3, "damaged": 1}
    assert reason in frame["error"][bad.name]
    assert details.read(bad)["state"] == "damaged"
    assert any(reason in problem for problem in details.read(bad)["problems"])
    assert "1 damaged" in ablation(load.runs(store), ["field"]).markdown()
    assert len(content.prepared(load.runs(store))) == 4
    content.dates(load.runs(store))


def test_a_stray_table_does_not_make_a_store_a_packed_folder(store: Path) -> None:
    pd.DataFrame({"x": [1]}).to_parquet(store / "runs.parquet")
    assert len(load.runs(store)) == 4
    assert len(packed.views(store / "poster-qcolor-s0")) == 2


def test_a_run_without_readable_views_is_packed_as_damaged(store: Path, bad: Path, tmp_path: Path) -> None:
    (bad / "eval.parquet").write_bytes(b"PAR1")
    finished, problems = packed.pack(load.runs(store), tmp_path / "packed")
    assert (finished, len(problems)) == (3, 1)
    assert load.runs(tmp_path / "packed").set_index("run_id")["state"][bad.name] == "damaged"


def header(width: int, height: int) -> bytes:
    """A PNG of one pixel that says it is larger."""
    sink = io.BytesIO()
    Image.new("RGB", (1, 1)).save(sink, "PNG")
    data = bytearray(sink.getvalue())
    data[16:24] = width.to_bytes(4, "big") + height.to_bytes(4, "big")
    return bytes(data)


EPS = b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 10 10\n%%EndComments\nshowpage\n"


@pytest.mark.parametrize("data", [EPS, b"", b"GIF89a", header(2**20, 400), header(0, 0), header(4, 4)[:40]])
def test_a_picture_is_a_small_png(store: Path, bad: Path, data: bytes) -> None:
    (bad / "images" / "0.png").write_bytes(data)
    with pytest.raises(StoreError, match=r"0\.png: "):
        images.panels(images.pictures(bad)["0"])
    frame = load.runs(store)
    gathered = pictures.gather(frame, range(4), 100)
    assert (gathered.views, len(gathered.problems)) == (7, 1)
    assert "1 pictures are damaged" in gathered.note


def test_names_are_drawn_as_they_are(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    for field in ("classical", "qcolor"):
        write_run(tmp_path / "runs", field)
    frame = load.runs(tmp_path / "runs").assign(scene_name="$\\frac{ \x1b", encoder=["$x_{", "$y^$"])
    draw(frame, ["speed"], tmp_path / "out", ["svg"])
    assert "$\\frac{ \\x1b" in (tmp_path / "out" / "speed.svg").read_text()


def test_a_figure_that_fails_is_named_and_the_rest_are_drawn(
    store: Path, tmp_path: Path, capsys: pytest.CaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    def broken(*_: object, **__: object) -> None:
        raise KeyError("column")

    monkeypatch.setattr("qnerf.analysis.figures.catalogue.Entry.draw", broken)
    draw(load.runs(store), [], tmp_path / "out", ["png"])
    assert re.search("not drawn: .*speed.*: KeyError: 'column'", capsys.readouterr().out)
    with pytest.raises(ValueError, match="KeyError: 'column'; KeyError: 'column'"):
        draw(load.runs(store), ["speed", "time"], tmp_path / "out", ["png"])
