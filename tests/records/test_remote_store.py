"""Stores behind URLs: in fsspec's memory, and on a real S3 server on this machine."""

import json
import time
import uuid
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import fsspec
import pandas as pd
import pytest

from qnerf.records import RunStore, StoreError, index
from qnerf.records.index import locations, remote
from qnerf.records.index.locations import ANNOTATIONS, STATUS, SUMMARY

CONFIG = {"seed": 0, "train": {"lr": 0.01, "steps": 10}}


@pytest.fixture(autouse=True)
def _cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("QNERF_CACHE", str(tmp_path / "cache"))


@pytest.fixture(scope="module")
def server() -> Iterator[str]:
    """Address of an S3 server."""
    pytest.importorskip("s3fs")
    moto = pytest.importorskip("moto.server")
    running = moto.ThreadedMotoServer(ip_address="127.0.0.1", port=0, verbose=False)
    running.start()
    host, port = running.get_host_and_port()
    yield f"http://{host}:{port}"
    running.stop()


@pytest.fixture(params=["memory", "s3"])
def url(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> str:
    """URL of an empty store."""
    name = uuid.uuid4().hex
    if request.param == "memory":
        return f"memory://{name}/runs"
    settings = {"AWS_ENDPOINT_URL": request.getfixturevalue("server"), "AWS_DEFAULT_REGION": "us-east-1"}
    for key, value in (settings | {"AWS_ACCESS_KEY_ID": "test", "AWS_SECRET_ACCESS_KEY": "test"}).items():
        monkeypatch.setenv(key, value)
    fsspec.filesystem("s3", skip_instance_cache=True).mkdir(f"s3://{name}")
    return f"s3://{name}/runs"


@pytest.fixture
def store(tmp_path: Path) -> RunStore:
    """Three runs on this machine: finished, failed, and one that says "running"."""
    store = RunStore(tmp_path / "runs", every=60)
    for number, name in enumerate(("done", "broken", "going")):
        run = store.claim(name, CONFIG | {"seed": number}, columns={"field": "qcolor"}).run
        assert run is not None
        for step in range(5):
            run.log(step, 0.1 * step, {"loss": 1 / (step + 1), "lr": 0.01})
        if name == "done":
            run.finish({"psnr": 21.5})
        elif name == "broken":
            run.fail("out of memory")
        else:
            run.flush()
            run._stop()
            run._closed = True
    (store.root / "done" / ANNOTATIONS).write_text('{"tags": ["good"], "note": "a note"}')
    return store


@pytest.fixture
def fetched(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Paths of the files that are fetched from now on."""
    seen: list[str] = []
    contents = remote.UrlLocation._contents

    def recording(location: remote.UrlLocation, paths: list[str], max_bytes: int) -> Iterator[Any]:
        seen.extend(paths)
        return contents(location, paths, max_bytes)

    monkeypatch.setattr(remote.UrlLocation, "_contents", recording)
    return seen


def files(url: str) -> tuple[Any, str]:
    return fsspec.url_to_fs(url, skip_instance_cache=True)


def upload(store: RunStore, url: str) -> None:
    system, root = files(url)
    for path in store.root.rglob("*"):
        if path.is_file() and "/." not in str(path.relative_to(store.root.parent)):
            system.pipe_file(f"{root}/{path.relative_to(store.root)}", path.read_bytes())


def test_a_remote_store_reads_like_one_here(store: RunStore, url: str) -> None:
    upload(store, url)
    here, there = index.load(store.root), index.load(url)
    assert there["path"].tolist() == [f"{url}/{name}" for name in ("broken", "done", "going")]
    assert there["tags"].tolist() == [(), ("good",), ()]
    pd.testing.assert_frame_equal(here.drop(columns="path"), there.drop(columns="path"))
    pd.testing.assert_frame_equal(index.load(f"file://{store.root}"), here)


def test_only_what_changed_is_fetched(
    store: RunStore, url: str, fetched: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(locations, "SETTLED", -3600.0)
    upload(store, url)
    index.load(url)
    assert len(fetched) == 7
    fetched.clear()
    index.load(url)
    assert fetched == []
    system, root = files(url)
    status = json.loads(system.cat_file(f"{root}/broken/{STATUS}"))
    system.pipe_file(f"{root}/broken/{STATUS}", json.dumps(status | {"state": "finished", "error": None}).encode())
    system.pipe_file(f"{root}/going/{SUMMARY}", b"damaged")
    system.rm(f"{root}/done", recursive=True)
    frame = index.load(url)
    assert fetched == [f"broken/{STATUS}", f"broken/{SUMMARY}", f"going/{SUMMARY}"]
    assert frame["run_id"].tolist() == ["broken", "going"]
    assert frame["state"].tolist() == ["finished", "damaged"]


def test_the_index_of_a_remote_store_lies_in_the_cache(store: RunStore, url: str, tmp_path: Path) -> None:
    upload(store, url)
    before = sorted(files(url)[0].find(files(url)[1]))
    index.load(url)
    assert sorted(files(url)[0].find(files(url)[1])) == before
    assert len(list((tmp_path / "cache" / "index").glob("*/*.index"))) == 3


@pytest.mark.parametrize(
    ("age", "state"), [(0, "running"), (170, "running"), (190, "interrupted"), (-190, "interrupted")]
)
def test_only_the_heartbeat_tells_whether_a_remote_run_lives(store: RunStore, age: float, state: str) -> None:
    url = f"memory://{uuid.uuid4().hex}"
    path = store.root / "going" / STATUS
    record = json.loads(path.read_text()) | {"host": "elsewhere", "pid": 1, "heartbeat": time.time() - age}
    path.write_text(json.dumps(record))
    upload(store, url)
    assert index.load(url).set_index("run_id")["state"]["going"] == state


def test_metrics_of_a_remote_run(store: RunStore, url: str) -> None:
    upload(store, url)
    run = remote.UrlLocation(f"{url}/done")
    pd.testing.assert_frame_equal(run.metrics(), locations.FolderLocation(store.root / "done").metrics())
    system, root = files(url)
    system.pipe_file(f"{root}/done/metrics/notes.txt", b"not a part")
    assert len(run.metrics()) == 10
    system.pipe_file(f"{root}/done/metrics/part-00001.parquet", b"damaged")
    with pytest.raises(StoreError, match=rf"^{url}/done/metrics/part-00001\.parquet: damaged"):
        run.metrics()


def test_there_may_be_no_remote_store(url: str) -> None:
    assert index.load(url).empty
    assert index.load(f"{url}/deeper/").empty


def test_a_storage_without_tags_is_told_by_its_times() -> None:
    now = time.time()
    assert remote._stamp({"size": 5, "mtime": now - 100}, now - 10) == f"5 {now - 100!r}"
    assert remote._stamp({"size": 5, "mtime": now - 1}, now - 10) == locations.UNSETTLED
    assert remote._stamp({"size": 5}, now - 10) == locations.UNSETTLED
    assert remote._stamp({"size": 5, "ETag": '"x"', "LastModified": now}, now - 10) == '5 "x"'


def test_a_missing_package_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    def missing(url: str) -> None:
        raise ImportError("Install s3fs to access S3")

    monkeypatch.setattr(remote.fsspec, "url_to_fs", missing)
    with pytest.raises(StoreError, match=r"^s3://bucket/runs: reading s3:// needs .*: pip install 'qnerf\[s3\]'$"):
        index.load("s3://bucket/runs")
    with pytest.raises(StoreError, match=r"reading gs:// needs another package: Install s3fs"):
        index.load("gs://bucket/runs")


def test_an_unknown_protocol_is_one_line() -> None:
    with pytest.raises(StoreError, match=r"^nothing://x: cannot read: Protocol not known: nothing"):
        index.load("nothing://x")


def test_a_server_that_does_not_answer_is_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    s3fs = pytest.importorskip("s3fs")
    for key, value in {"ENDPOINT_URL": "http://127.0.0.1:9", "MAX_ATTEMPTS": "1", "ACCESS_KEY_ID": "test"}.items():
        monkeypatch.setenv(f"AWS_{key}", value)
    monkeypatch.setenv("AWS_SECRET_ACCESS_KEY", "test")
    s3fs.S3FileSystem.clear_instance_cache()
    with pytest.raises(StoreError, match=r"^s3://bucket/runs: cannot read: ") as error:
        index.load("s3://bucket/runs")
    assert "\n" not in str(error.value)
    s3fs.S3FileSystem.clear_instance_cache()


def test_a_web_server_that_does_not_answer_is_one_line() -> None:
    pytest.importorskip("aiohttp")
    with pytest.raises(StoreError, match=r"^http://127\.0\.0\.1:9/x: cannot read: ") as error:
        index.load("http://127.0.0.1:9/x")
    assert "\n" not in str(error.value)


def test_a_large_file_is_not_fetched(store: RunStore, url: str, monkeypatch: pytest.MonkeyPatch) -> None:
    upload(store, url)
    monkeypatch.setitem(remote.MAX_BYTES, SUMMARY, 10)
    frame = index.load(url)
    assert "larger than the 10 bytes" in frame["error"].dropna().iloc[0]
    assert set(frame["state"]) == {"damaged"}
