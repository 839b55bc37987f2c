import json
from pathlib import Path

from qnerf.cli.commands.diff import differences, results


def test_differences_of_configuration_and_results(store, qnerf):
    out = qnerf("diff", "aaaa", "bbbb").out
    assert out.splitlines()[0] == "A  poster-qcolor-s0-aaaaaaaaaa  finished"
    rows = {line.split()[0]: line.split()[1:] for line in out.splitlines() if len(line.split()) >= 3}
    assert rows["train.lr"] == ["0.01", "0.02"]
    assert rows["psnr"] == ["21.5", "23.25", "+1.75"]
    assert "train.steps" not in rows
    assert "no differences in environment" in out


def test_runs_with_one_configuration_say_so(store, make, qnerf):
    (run,) = store.glob("*-aaaaaaaaaa")
    other = make("poster-qcolor-s0-1111111111", psnr=21.0)
    out = qnerf("diff", run, other).out
    assert "no differences in configuration" in out
    assert "the ids differ, so the scene's files differ" in out
    assert "the ids differ" not in qnerf("diff", run, run).out


def test_the_environment_without_the_command(store, qnerf):
    (a,), (b,) = store.glob("*-aaaaaaaaaa"), store.glob("*-bbbbbbbbbb")
    environment = json.loads((b / "environment.json").read_text())
    environment["packages"]["torch"] = "2.14.0"
    environment["command"] = ["another"]
    (b / "environment.json").write_text(json.dumps(environment))
    found = qnerf("diff", a, b, "--json").json
    assert found["environment"] == {"packages.torch": ["2.13.0", "2.14.0"]}


def test_threads_and_store_are_not_the_configuration(store, qnerf):
    (run,) = store.glob("*-bbbbbbbbbb")
    text = (run / "config.yaml").read_text()
    (run / "config.yaml").write_text(text.replace("threads: 1", "threads: 2"))
    found = qnerf("diff", "aaaa", "bbbb", "--json").json
    assert found["execution"] == {"threads": [1, 2]}
    assert found["configuration"] == {"train.lr": [0.01, 0.02]}


def test_a_damaged_run_is_compared_as_far_as_it_goes(store, qnerf):
    done = qnerf("diff", "aaaa", "eeee")
    assert done.code == 0
    assert "summary.parquet: damaged" in done.out
    assert [line.split() for line in done.out.splitlines() if line.startswith("psnr")] == [["psnr", "21.5", "-", "-"]]


def test_differences_are_of_what_either_has():
    assert differences({"a": 1, "b": 2, "c": None}, {"a": 1, "b": 3, "d": 4}) == {"b": [2, 3], "d": [None, 4]}
    assert results({"x": 1.0, "y": "text", "t": True}, {"x": 3.0, "z": 2}) == {
        "x": [1.0, 3.0, 2.0],
        "z": [None, 2, None],
    }


def test_an_unknown_run_is_one_line(store, qnerf):
    done = qnerf("diff", "aaaa", "nowhere")
    assert done.code == 2
    assert done.err.count("\n") == 1
    assert Path("nowhere").name in done.err
