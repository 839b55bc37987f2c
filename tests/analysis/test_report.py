import base64
import io
import json
import re
from html.parser import HTMLParser

import numpy as np
import pandas as pd
import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image
from qnerf.analysis.images import panels, pictures
from qnerf.analysis.load import metrics, runs
from qnerf.analysis.report import columns, content, curves, figures, page, parts, tables
from qnerf.analysis.report.__main__ import main, page_content, parser
from qnerf.analysis.report.pictures import Pictures, gather
from qnerf.analysis.tables import Table, ablation

from tests.helpers.packed_stores import picture, write_run
from tests.helpers.sweep import FIELDS, SEEDS

EVIL = "</script><script>alert(1)</script><img src=x onerror=alert(2)>\"'`&amp;javascript:alert(3)"


@pytest.fixture(scope="module")
def frame(trained):
    return content.prepared(runs(trained))


@pytest.fixture(scope="module")
def gathered_once(trained):
    return page_content(runs(trained), parser().parse_args([str(trained), "--title", EVIL]), print)


@pytest.fixture(scope="module")
def html(gathered_once):
    return page.render(gathered_once)


class Scripts(HTMLParser):
    """The script elements of a page: attributes and text, and every element with an address."""

    def __init__(self, html):
        super().__init__()
        self.scripts, self.addresses, self.inside = [], [], False
        self.feed(html)

    def handle_starttag(self, tag, attributes):
        self.inside = tag == "script"
        if self.inside:
            self.scripts.append([dict(attributes), ""])
        self.addresses += [value for name, value in attributes if name in ("src", "href")]

    def handle_endtag(self, tag):
        self.inside = False

    def handle_data(self, data):
        if self.inside:
            self.scripts[-1][1] += data


def unpacked(packed, total):
    if "values" in packed:
        return packed["values"]
    return [packed["all"]] * total


VALUES = st.none() | st.booleans() | st.integers(-(2**40), 2**40) | st.floats() | st.text(max_size=5)


@given(st.lists(VALUES | st.lists(st.text(max_size=2), max_size=2), min_size=1, max_size=12))
def test_a_packed_column_holds_the_values_that_went_in(values):
    frame = pd.DataFrame({"column": pd.Series(values, dtype=object)})
    plain = [columns.plain(value) for value in values]
    packed = json.loads(json.dumps(columns.packed(frame), allow_nan=False))
    if packed:
        assert list(map(repr, unpacked(packed["column"], len(values)))) == list(map(repr, plain))
    else:
        assert plain == [None] * len(values)


@given(st.integers(1, 400), st.integers(1, 50))
def test_thinned_curves_keep_the_mean_and_the_end(rows, points):
    steps = np.arange(1, rows + 1)
    logged = pd.DataFrame({"step": steps, "time_s": steps / 8, "value": np.sin(steps)})
    found = curves.thinned(logged, points)
    lengths = np.diff([0, *found["step"]])
    assert len(found["step"]) <= points
    assert found["step"][-1] == rows
    assert np.average(found["value"], weights=lengths) == pytest.approx(np.sin(steps).mean(), abs=1e-4)
    if rows <= points:
        assert found["value"] == pytest.approx(np.sin(steps), abs=1e-4)


def test_curves_are_what_the_runs_logged(frame):
    found = curves.gather(frame, range(len(frame)))
    row = frame.index[(frame["field"] == "qcolor") & (frame["seed"] == 1)][0]
    logged = metrics(frame["path"][row], "train/psnr")
    assert found[row]["train/psnr"]["step"] == logged["step"].tolist() == [1, 2, 3, 4, 5, 6]
    assert found[row]["train/psnr"]["value"] == pytest.approx(logged["value"], rel=1e-4)
    assert len(curves.gather(frame, range(len(frame)), max_runs=2)) == 2
    unfinished = frame.index[frame["state"] == "failed"][0]
    assert unfinished not in found


def pixels(uri):
    return np.asarray(Image.open(io.BytesIO(base64.b64decode(uri.partition(",")[2]))).convert("RGB"))


def test_pictures_are_the_runs_own_and_the_truth_is_there_once(frame):
    found = gather(frame, range(len(frame)), 100)
    finished = frame.index[frame["state"] == "finished"]
    assert sorted(found.runs) == sorted(finished)
    views = {row: list(found.runs[row]) for row in finished}
    truths = {found.runs[row][view]["truth"] for row in finished for view in views[row]}
    assert len(truths) == len(views[finished[0]])
    for row in finished:
        stored = pictures(frame["path"][row])
        assert list(stored) == views[row]
        for view, path in stored.items():
            for kind, place in found.runs[row][view].items():
                assert (pixels(found.files[place]["uri"]) == panels(path)[kind]).all()


def test_pictures_stop_at_their_number_and_their_bytes_and_say_so(frame):
    views = len(pictures(frame["path"][frame["state"].eq("finished").idxmax()]))
    found = gather(frame, range(len(frame)), views)
    assert (len(found.runs), found.views, found.left_out) == (1, views, 3)
    assert "3 runs have no pictures here" in found.note
    assert len(gather(frame, range(len(frame)), 100, budget=1).runs) == 1


def test_a_signals_picture_has_three_panels(tmp_path):
    parts = np.random.default_rng(0).integers(0, 255, (4, 8, 12, 3), dtype=np.uint8)
    for signal, own in ((True, parts[:3]), (False, parts)):
        run = write_run(tmp_path, seed=len(own), pictures={"one": picture(*own)})
        found = panels(run / "images" / "one.png", signal=signal)
        assert list(found) == ["truth", "render", "error", "depth"][: len(own)]
        assert (np.stack(list(found.values())) == own).all()


def test_every_configuration_gets_a_place_before_its_second_seed(frame):
    ordered = frame.loc[content.order(frame)]
    states = ordered["state"].tolist()
    assert states == ["finished"] * 4 + states[4:]
    assert set(ordered["field"][:2]) == set(FIELDS)
    best = frame[frame["state"] == "finished"].groupby("field")["psnr"].max()
    assert ordered["psnr"][:2].tolist() == sorted(best, reverse=True)


def test_the_page_holds_the_numbers_of_the_runs(html, frame):
    data = json.loads(next(text for attributes, text in Scripts(html).scripts if attributes.get("id") == "data"))
    assert data["total"] == len(frame) == len(FIELDS) * len(SEEDS) + 2
    psnr = np.array(unpacked(data["columns"]["psnr"], len(frame)), dtype=float)
    assert psnr == pytest.approx(frame["psnr"].to_numpy(), rel=1e-5, nan_ok=True)
    assert unpacked(data["columns"]["state"], len(frame)) == frame["state"].tolist()
    assert set(data["settings"]) >= {"seed", "train.steps", "color.qiren.layers"}
    assert not {"psnr", "params.color", "time.field_ms"} & set(data["settings"])
    row = ablation(frame, ["field"]).data.loc["qcolor"]
    assert f"{row['psnr', 'mean']:.2f} ± {row['psnr', 'std']:.2f}" in html


def test_runs_that_did_not_finish_are_counted_and_not_averaged_in(html):
    text = re.sub(r"<[^>]+>|\s+", " ", html.partition("<nav")[0])
    for count, state in ((4, "finished"), (1, "failed"), (1, "interrupted")):
        assert re.search(rf"\b{count} +{state}", text)
    assert "left out: 1 failed, 1 interrupted" in html


def test_hostile_values_stay_inside_their_cells_and_their_json(frame, gathered_once):
    hostile = frame.assign(note=EVIL, run_id=EVIL, listed=[("<b>", EVIL)] * len(frame), **{EVIL: 1})
    table = tables.attempt(EVIL, lambda: tables_of_one(EVIL))
    section = parts.Part("evil", EVIL, EVIL, [table], absent=[EVIL])
    data = content.data(hostile, Pictures(), {})
    text = page.render(gathered_once | {"data": data, "parts": [section], "states": [(EVIL, 1)], "store": EVIL})
    found = Scripts(text)
    assert len(found.scripts) == 3
    read = json.loads(found.scripts[0][1])["columns"]
    assert (read["note"], read["listed"], read[EVIL]) == ({"all": EVIL}, {"all": ["<b>", EVIL]}, {"all": 1})
    assert "<img src=x" not in text
    assert all(address.startswith(("#", "data:")) for address in found.addresses)


def tables_of_one(text):
    cells = pd.DataFrame({text: [text]})
    return Table(text, cells, cells, cells == "", (text,))


def test_the_policy_lets_the_pages_own_scripts_run_and_nothing_else(html):
    policy = re.search(r'Content-Security-Policy" content="([^"]+)"', html)[1].replace("&#39;", "'")
    rules = dict(rule.strip().split(" ", 1) for rule in policy.split(";"))
    assert rules["default-src"] == "'none'"
    (nonce,) = re.findall('<script nonce="([^"]{20,})">', html)
    assert rules["script-src"] == f"'nonce-{nonce}'"


def test_a_figure_that_cannot_be_drawn_says_why(frame):
    drawn, absent = figures.draw("speed", frame)
    (figure,) = drawn
    assert absent == {}
    assert base64.b64decode(figure.image.partition(",")[2]).startswith(b"<?xml")
    nothing, reasons = figures.draw("shots", frame)
    assert nothing == []
    assert "`qnerf probe RUN shots=100,1000` writes it" in reasons["PSNR against shots"]


def test_a_store_without_a_finished_run_has_a_page_that_says_so(tmp_path):
    write_run(tmp_path / "runs", state="failed")
    main([str(tmp_path / "runs"), "--out", str(tmp_path / "report")])
    (written,) = (tmp_path / "report").iterdir()
    assert written.name == "index.html"
    text = written.read_text(encoding="utf-8")
    assert "no finished runs among 1" in text
    assert "No pictures: packed runs" in text
    assert "No run has logged" in text
