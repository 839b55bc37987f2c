import math

import pytest
from rich.cells import cell_len

from qnerf.cli.table import Column, fitting
from qnerf.cli.text import age, count, duration


def ids(done):
    """Last letters of the ids, in the order of the table."""
    return [line.split()[0][-1] for line in done.out.splitlines()[1:]]


def test_runs_is_plain_text_with_full_ids_in_a_pipe(store, qnerf):
    titles, *lines = (line.split() for line in qnerf("runs", "--sort", "psnr").out.splitlines())
    assert titles == [
        "id", "state", "scene_name", "field", "encoder", "color", "params", "heads", "PSNR", "SSIM", "steps", "time",
        "age", "error",
    ]  # fmt: skip
    assert all(len(line) == len(titles) for line in lines)
    rows = {line[0]: dict(zip(titles, line, strict=True)) for line in lines}
    assert list(rows)[:2] == ["poster-classical-s0-bbbbbbbbbb", "poster-qcolor-s0-aaaaaaaaaa"]
    first = rows["poster-qcolor-s0-aaaaaaaaaa"]
    assert [first[title] for title in titles[1:12]] == [
        "finished", "poster", "qcolor", "hash", "1L2S", "1234", "234", "21.50", "0.500", "40", "1m40s",
    ]  # fmt: skip
    assert rows["poster-classical-s0-bbbbbbbbbb"]["color"] == "3x64"
    failed = rows["poster-qcolor-s1-cccccccccc"]
    assert [failed[title] for title in ("state", "PSNR", "steps", "error")] == ["failed", "-", "20/40", "loss_is_NaN"]
    assert rows["poster-qcolor-s2-dddddddddd"]["state"] == "interrupted"
    assert rows["poster-qboth-s0-eeeeeeeeee"]["state"] == "damaged"


def test_runs_takes_filters_an_order_and_a_limit(store, qnerf):
    for line, found in {
        "psnr=none state!=damaged": "dc",
        "--sort psnr --reverse --limit 2": "ab",
        "--sort id --limit 1": "b",
        "--sort state state!=finished": "ecd",
    }.items():
        assert "".join(ids(qnerf("runs", *line.split()))) == found, line


def test_runs_as_json_has_numbers_in_full_and_null_for_none(store, qnerf):
    found = {row["run_id"][-1]: row for row in qnerf("runs", "--json", "--columns", "train.lr").json}
    assert (found["a"]["psnr"], found["a"]["train.lr"]) == (21.5, 0.01)
    assert found["c"]["psnr"] is None
    assert found["e"]["state"] == "damaged"
    assert len(qnerf("runs", "--json", "--all-columns").json[0]) > len(found["a"])


def test_runs_prints_ids_alone(store, qnerf):
    assert qnerf("runs", "--ids", "field=classical").out == "poster-classical-s0-bbbbbbbbbb\n"


def test_runs_shows_further_columns(store, qnerf):
    line = qnerf("runs", "--columns", "seed,train.lr,heartbeat", "aaaa").out.splitlines()
    assert line[0].split()[-3:] == ["seed", "train.lr", "heartbeat"]
    assert line[1].split()[-3:-1] == ["0", "0.01"]
    assert "scene.name" in qnerf("runs", "--all-columns").out.splitlines()[0].split()


def test_runs_refuses_mistakes_in_one_line(store, qnerf):
    for line, message in {
        "layers>1": "no run has a column 'layers'; did you mean ",
        "--sort quality": "no run has a column 'quality'",
        "--columns sed": "did you mean seed",
        "store=elsewhere": "store=elsewhere: the folder of runs is an option, --store elsewhere",
    }.items():
        done = qnerf("runs", *line.split())
        assert (done.code, done.out, done.err.count("\n")) == (2, "", 1)
        assert message in done.err


def test_runs_of_an_empty_store_and_of_no_match(store, qnerf, tmp_path):
    assert qnerf("runs", "seed=7").out == f"no run of 5 in {store} has seed=7; there are seed: 0, 1, 2\n"
    assert qnerf("runs", "seed=7", "--json").json == []
    for path in store.iterdir():
        path.rename(tmp_path / path.name)
    assert qnerf("runs", "seed=7").out == f"no runs in {store}\n"
    assert qnerf("runs", "--ids").out == ""
    assert qnerf("runs", "--json").json == []
    (store / "runs.parquet").touch()
    assert "got tables made by qnerf pack" in qnerf("runs").err


@pytest.mark.parametrize("width", [65, 100, 200])
def test_runs_on_a_terminal_has_no_wider_line_and_whole_ids(store, qnerf, terminal, width):
    terminal(width)
    *lines, last = qnerf("runs").out.splitlines()
    assert max(map(cell_len, lines)) <= width
    assert lines[0].startswith("id")
    assert {line.split()[0][-10:] for line in lines[1:]} == {letter * 10 for letter in "abcde"}
    assert ("params" in lines[0]) == ("error" in lines[0]) == (width == 200)
    assert last.startswith("5 runs: 2 finished, ")


def test_runs_gives_a_terminal_what_its_screen_holds(make, qnerf, terminal):
    for number in range(12):
        make(f"run-{number:010d}", "interrupt")
    terminal(100, height=12)
    lines = qnerf("runs").out.splitlines()
    assert len(lines) == 10
    assert lines[-1].endswith("… 4 more (--limit 0 shows all)")
    assert len(qnerf("runs", "--limit", "0").out.splitlines()) == 14


def test_a_run_that_is_running(running, qnerf):
    titles, line = (line.split() for line in qnerf("runs", "state=running").out.splitlines())
    assert dict(zip(titles, line, strict=True))["steps"] == "20/40"
    assert "PSNR" not in titles  # a column that no run fills


def test_columns_that_do_not_fit_go_by_rank():
    columns = {Column(name, lambda row: "", rank): 10 for name, rank in (("a", 0), ("b", 2), ("c", 1), ("d", 0))}
    for width, kept in ((46, "abcd"), (45, "acd"), (33, "ad"), (5, "ad")):
        assert "".join(column.title for column in fitting(columns, width)) == kept


def test_durations_and_ages_as_text(monkeypatch):
    durations = {
        0: "0.0s", 4.26: "4.3s", 9.96: "10s", 43.4: "43s", 59.7: "1m00s", 113: "1m53s", 3599: "59m59s", 7500: "2h05m",
        273600: "3d04h", None: "-", math.nan: "-", math.inf: "inf", -3: "0.0s", "text": "text",
    }  # fmt: skip
    assert [duration(seconds) for seconds in durations] == list(durations.values())
    monkeypatch.setattr("time.time", lambda: 1e9)
    ages = {5: "5s", 100: "100s", 150: "2m", 7300: "2h", 200_000: "2d", -50: "0s"}
    assert [age(1e9 - seconds) for seconds in ages] == list(ages.values())
    assert age(None) == age(math.nan) == "-"


def test_counts_as_text():
    assert (count(1234567), count(None), count(3.0)) == ("1,234,567", "-", "3")
