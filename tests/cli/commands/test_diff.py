import json

from qnerf.cli.commands.diff import differences


def test_diff_of_configuration_environment_and_results(store, qnerf):
    (b,) = store.glob("*-bbbbbbbbbb")
    environment = json.loads((b / "environment.json").read_text())
    environment["packages"]["torch"] = "2.14.0"
    environment["command"] = ["another"]
    (b / "environment.json").write_text(json.dumps(environment))
    out = qnerf("diff", "aaaa", "bbbb").out
    assert out.splitlines()[0] == "A  poster-qcolor-s0-aaaaaaaaaa  finished"
    rows = {line.split()[0]: line.split()[1:] for line in out.splitlines() if len(line.split()) >= 3}
    assert rows["train.lr"] == ["0.01", "0.02", "0.01"]
    assert rows["psnr"] == ["21.5", "23.25", "1.75"]
    assert rows["packages.torch"] == ["2.13.0", "2.14.0", "-"]
    assert "train.steps" not in rows
    found = qnerf("diff", "aaaa", "bbbb", "--json").json
    assert (found["configuration"], set(found["environment"])) == ({"train.lr": [0.01, 0.02, 0.01]}, {"packages.torch"})


def test_diff_of_runs_with_one_configuration(store, make, qnerf):
    (run,) = store.glob("*-aaaaaaaaaa")
    other = make("poster-qcolor-s0-1111111111", psnr=21.0)
    out = qnerf("diff", run, other).out
    assert "no differences in configuration" in out
    assert "no differences in environment" in out


def test_diff_of_a_damaged_run_goes_as_far_as_it_can(store, qnerf):
    done = qnerf("diff", "aaaa", "eeee")
    assert done.code == 0
    assert "summary.parquet: damaged" in done.out
    assert [line.split() for line in done.out.splitlines() if line.startswith("psnr")] == [["psnr", "21.5", "-", "-"]]


def test_differences_are_of_what_either_has():
    found = differences({"a": 1, "b": 2, "c": None, "e": "text"}, {"a": 1, "b": 3.5, "d": 4, "e": True})
    assert found == {"b": [2, 3.5, 1.5], "d": [None, 4, None], "e": ["text", True, None]}
