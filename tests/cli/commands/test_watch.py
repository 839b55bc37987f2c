import io

import pandas as pd
import pytest
from rich.console import Console
from rich.text import Text

from qnerf.cli.commands import watch
from qnerf.records import details, read_metrics


def test_a_run_once(running, qnerf):
    lines = qnerf("watch", "ffff", "--once").out.splitlines()
    assert lines[0] == "live-qcolor-s0-ffffffffff"
    assert lines[1].startswith("running  20 of 40 steps")
    assert lines[2].split()[1:] == ["50%", "10.0", "steps/s", "2.0s", "left"]
    assert lines[3].split()[-4:] == ["0.25000", "at", "step", "20"]
    assert lines[4].split()[1:] == ["▁█", "15.00", "dB", "at", "step", "20"]


def test_a_run_that_has_ended_is_shown_once_and_not_waited_for(store, qnerf, terminal):
    terminal(100)
    out = qnerf("watch", "cccc").out
    assert "failed" in out
    assert "loss is NaN" in out


def test_lines_fit_the_terminal(running):
    run, metrics = details.read(running.dir), read_metrics(running.dir)
    for width in (60, 100, 200):
        assert all(line.cell_len <= width for line in watch.progress(run, metrics, width)[2:])


def test_it_follows_until_the_run_ends(running):
    out = Console(file=io.StringIO(), force_terminal=True, width=100)
    frames = []

    def frame() -> tuple[Text, bool]:
        if len(frames) == 2:
            running.finish()
        _, goes_on = watch.run_frame(running.dir, out)
        frames.append(goes_on)
        return Text(f"frame {len(frames)}"), goes_on

    watch.follow(out, frame, every=0.01)
    assert frames == [True, True, False]
    assert "frame 3" in out.file.getvalue()


def test_ctrl_c_leaves_it(running, qnerf, terminal, monkeypatch):
    terminal(100)

    def stop(_: float) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("time.sleep", stop)
    assert qnerf("watch", "ffff").code == 0


def test_the_store_once(store, qnerf):
    out = qnerf("watch", "--once").out
    assert "poster-classical-s0-bbbbbbbbbb" in out
    assert "5 runs:" in out


def test_no_store_yet(qnerf, tmp_path):
    assert f"{tmp_path / 'runs'}: no such folder" in qnerf("watch", "--once").err
    (tmp_path / "runs").mkdir()
    assert qnerf("watch", "--once").out == f"no runs in {tmp_path / 'runs'}\n"


def test_the_rate_is_that_of_the_last_rows():
    rows = pd.DataFrame({"step": range(100), "time_s": [*range(50), *(50 + i / 10 for i in range(50))]})
    assert watch.steps_per_second(rows) == pytest.approx(10)
    assert watch.steps_per_second(rows.head(1)) is None


def test_seconds_between_refreshes_are_a_finite_number(store, qnerf):
    for text in ("0", "-1", "inf", "nan", "1e300", "soon"):
        done = qnerf("watch", f"--every={text}")
        assert done.code == 2
        assert done.err.endswith(f"--every: expected a number above 0 to 86400, got {text!r}\n")
