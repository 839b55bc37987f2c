"""The live page's server: what changed, curves, differences, and who may ask."""

import concurrent.futures
import json
import re
import threading
import urllib.error
import urllib.parse
import urllib.request

import numpy as np
import pytest
from qnerf.analysis.serve import store as serve_store
from qnerf.analysis.serve.__main__ import main
from qnerf.analysis.serve.answers import Answers
from qnerf.analysis.serve.store import WatchedStore
from qnerf.analysis.tables import ablation

from qnerf.records import RunStore
from tests.helpers.packed_stores import picture, write_run
from tests.helpers.serving import EVIL, cookie, served
from tests.helpers.stores import vanish


def ask(address, headers=None, data=None):
    """Status and text of an answer."""
    request = urllib.request.Request(address, data=data, headers=cookie(address) | (headers or {}))
    try:
        with urllib.request.urlopen(request, timeout=30) as answer:
            return answer.status, answer.read().decode(errors="replace")
    except urllib.error.HTTPError as error:
        return error.code, error.read().decode()


def query(address, path, **pairs):
    status, text = ask(f"{address}/{path}?{urllib.parse.urlencode(pairs, doseq=True)}")
    return (status, json.loads(text)) if text.startswith("{") else (status, text)


def data_of(page):
    return json.loads(re.search(r'id="data"[^>]*>(.*?)</script>', page)[1])


@pytest.fixture(scope="module")
def many(tmp_path_factory):
    """Two fields with three seeds each, and a hostile one."""
    store = tmp_path_factory.mktemp("serve") / "runs"
    panels = np.random.default_rng(0).integers(0, 255, (4, 5, 6, 3), dtype=np.uint8)
    for seed in range(3):
        write_run(store, seed=seed, psnr=(20.0 + seed, 22.0), pictures={"0": picture(*panels)})
        write_run(store, "qcolor", seed=seed, psnr=(21.0 + seed, 22.5))
    run = write_run(store, seed=9, state="failed", config={"experiment": EVIL})
    run.rename(run.with_name("<img src=x onerror=alert(3)>"))
    return store


@pytest.fixture(scope="module")
def address(many):
    with served(many) as (address, _):
        yield address


def test_a_page_learns_of_new_rows_and_of_curves_that_grow(tmp_path, monkeypatch):
    monkeypatch.setattr(serve_store, "FRESH", 0.0)

    def rows(news):
        columns, total = news["data"]["columns"], news["data"]["total"]
        values = {name: packed.get("values") or [packed["all"]] * total for name, packed in columns.items()}
        return {run: {name: column[row] for name, column in values.items()} for row, run in enumerate(values["run_id"])}

    with served(tmp_path) as (address, _):
        before = data_of(ask(address)[1])
        assert before["total"] == 0
        run = RunStore(tmp_path).claim("first", {"seed": 0, "train": {"steps": 10}}, columns={"field": "qcolor"}).run
        run.log(1, 0.1, {"train/psnr": 12.0})
        run.flush()
        _, news = query(address, "changes", since=before["version"])
        row = rows(news)["first"]
        assert (row["state"], row["field"], row["train.steps"]) == ("running", "qcolor", 10)
        assert query(address, "keys", run="first")[1] == {"train/psnr": "training PSNR, dB"}
        assert query(address, "curves", run="first", key="train/psnr")[1]["first"]["value"] == [12]
        run.log(2, 0.2, {"train/psnr": 13.0})
        run.finish({"psnr": 13.0, "steps": 2})
        assert query(address, "curves", run="first", key="train/psnr")[1]["first"]["value"] == [12, 13]
        _, later = query(address, "changes", since=news["version"])
        assert (rows(later)["first"]["state"], rows(later)["first"]["psnr"]) == ("finished", 13)
        assert query(address, "changes", since=later["version"])[1] == {"version": later["version"]}
        assert query(address, "changes", since="0-1")[1] == {"reload": True}


def test_the_watched_store_says_what_has_changed(tmp_path, monkeypatch):
    monkeypatch.setattr(serve_store, "FRESH", 0.0)
    store = tmp_path / "runs"
    first = write_run(store)
    watched = WatchedStore(store)
    assert watched.version() == watched.version() == 0
    write_run(store, seed=1)
    assert watched.version() == 1
    (first / "status.json").touch()
    version, frame = watched.frame()
    assert (version, set(frame["configuration"]), len(frame)) == (2, {"classical"}, 2)
    (store / "poster-classical-s1").rename(tmp_path / "elsewhere")
    assert watched.version() == 3
    run = RunStore(store).claim("live", {"seed": 0}).run
    assert list(watched.frame()[1]["state"]) == ["running", "finished"]
    before = watched.version()
    vanish(run)
    assert watched.version() > before


def test_differences_are_those_of_the_tables(address, many):
    _, text = query(
        address, "differences", filter="state=finished", rows="field", baseline="field=classical", metric="psnr"
    )
    frame = WatchedStore(many).frame()[1]
    table = ablation(frame[frame["state"] == "finished"], ["field"], baseline={"field": "classical"}).text
    for cell in table.loc[table["field"] == "qcolor"].iloc[0]:
        assert f">{cell}<" in text
    status, text = query(address, "differences", filter="", rows="colur", baseline="", metric="")
    assert status == 400
    assert "did you mean color" in text
    assert "\n" not in text


def test_pictures_are_panels_of_runs_of_the_store_alone(address):
    run = "poster-classical-s0"
    _, found = query(address, "views", run=run)
    assert found["views"]["0"]["depth"] == {"width": 6, "height": 5}
    assert query(address, "picture", run=run, view="0", panel="depth")[1][:4] == "RIFF"
    for wrong in ({"run": "../runs"}, {"view": "../0"}, {"panel": "other"}, {"panel": "preview"}):
        status, text = query(address, "picture", **({"run": run, "view": "0", "panel": "depth"} | wrong))
        assert status == 400, text


@pytest.mark.parametrize("host", ["127.0.0.1", "0.0.0.0"])
def test_nobody_asks_without_the_token_of_the_printed_address(many, host):
    with served(many, "--host", host) as (address, token):
        for path in ("", "changes?since=", "page.js", "views?run=poster-classical-s0", "?token=guess"):
            assert ask(f"{address}/{path}", {"Cookie": "qnerf_token=guess"})[0] == 403
        assert ask(address, {"Host": address.replace("http://127.0.0.1", "evil.example")})[0] == (
            403 if host == "127.0.0.1" else 200
        )
        opener = urllib.request.build_opener(urllib.request.HTTPCookieProcessor())
        with opener.open(f"{address}/?token={token}", timeout=30) as answer:
            assert answer.geturl() == f"{address}/"
            assert "default-src 'none'; script-src 'self'" in answer.headers["Content-Security-Policy"]


def test_serve_keeps_no_client_waiting_for_another(many, monkeypatch):
    """Many tables at once leave threads to the rest."""
    begun, free = threading.Event(), threading.Event()

    def slow(*_):
        begun.set()
        free.wait(30)
        raise ValueError("slow")

    monkeypatch.setattr(Answers, "differences", slow)
    with served(many) as (address, _), concurrent.futures.ThreadPoolExecutor(60) as clients:
        tables = [clients.submit(ask, f"{address}/differences") for _ in range(60)]
        assert begun.wait(30)
        assert ask(f"{address}/changes?since=")[0] == 200
        free.set()
        assert {table.result()[0] for table in tables} == {400}


def test_serve_refuses_folders_without_a_store(tmp_path):
    with pytest.raises(ValueError, match="no such folder"):
        main([str(tmp_path / "nowhere")])
    for name in ("runs", "views"):
        (tmp_path / f"{name}.parquet").write_bytes(b"")
    with pytest.raises(ValueError, match="packed runs, which do not change"):
        main([str(tmp_path)])
