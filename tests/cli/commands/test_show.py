import json


def test_show_tells_everything_about_a_run(store, qnerf):
    done = qnerf("show", "aaaa")
    assert done.code == 0
    lines = done.out.splitlines()
    assert lines[0] == "poster-qcolor-s0-aaaaaaaaaa"
    assert lines[1].startswith("finished  40 of 40 steps  started")
    for part in (
        "overrides  seed=0 field=qcolor",
        "1,234: density 200   color 34", "PSNR 21.50 dB   SSIM 0.500", "1m40s   25.0 ms per step",
        "view1.png  22.50  0.500", "code       c0ffee",
        "torch 2.13.0", "folder     ",
    ):  # fmt: skip
        assert part in done.out, part
    assert "lr: " not in done.out


def test_show_prints_the_configuration_as_yaml(store, qnerf):
    out = qnerf("show", "bbbb", "--config").out
    for line in ("seed: 0", "  lr: 0.02", "  path: null"):
        assert line in out.splitlines()


def test_a_failed_run_says_why(store, qnerf):
    out = qnerf("show", "cccc").out
    assert "failed  20 of 40 steps" in out
    assert "loss is NaN" in out.splitlines()


def test_a_running_run_says_where(running, qnerf):
    assert f", process {json.loads((running.dir / 'status.json').read_text())['pid']}" in qnerf("show", "ffff").out


def test_show_as_json_has_everything(store, qnerf):
    found = qnerf("show", "aaaa", "--json").json
    assert found["state"] == "finished"
    assert found["results"]["psnr"] == 21.5
    assert found["config"]["train"] == {"steps": 40, "lr": 0.01, "samples": [8, 6]}
    assert [row["psnr"] for row in found["evaluation"]] == [21.5, 22.5]
    assert found["evaluation"][0]["lpips"] is None
    assert found["environment"]["git"]["commit"] == "c0ffee"
    assert found["problems"] == []


def test_show_tells_what_is_damaged_and_shows_the_rest(store, qnerf):
    (run,) = store.glob("*-eeeeeeeeee")
    (run / "environment.json").write_text("nothing")
    done = qnerf("show", "eeee")
    assert done.code == 0
    for part in ("summary.parquet: damaged", "environment.json: damaged", "view0.png  20.00"):
        assert part in done.out, part
    (run / "status.json").unlink()
    assert "status.json: cannot read: No such file" in qnerf("show", "eeee").out


def test_show_is_no_wider_than_the_terminal(store, qnerf, terminal):
    terminal(60)
    out = qnerf("show", "aaaa").out
    pairs = [line for line in out.splitlines() if line.startswith("  ")]
    assert max(map(len, pairs)) <= 60
