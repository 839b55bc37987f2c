"""What the terminal shows of any configuration and any result."""

from pathlib import Path

from rich.console import Console

from qnerf.cli.display import LiveDisplay, print_outcome
from qnerf.cli.text import console
from qnerf.experiment import Outcome


def test_progress_lines_say_phase_time_and_which_views(capsys):
    metrics = {"train/loss": 0.01, "train/psnr": 20.0, "time/step_ms": 50.0}
    for terminal in (False, True):
        shown = Console(width=160, force_terminal=terminal, color_system=None)
        display = LiveDisplay(shown)
        display.begin(Path("runs/a"), 0, 10)
        start = capsys.readouterr().out
        assert "PSNR" not in start
        assert ("compile" in start) == terminal
        display.phase("train")
        display.step(1, metrics)
        display.phase("evaluate 1 of 1 views")
        for view in (1, 2):
            display.phase(f"evaluate {view} of 4 views")
        display.held_out(1, "psnr", 19.0, "4 of 22 views")
        display.step(2, metrics)
        display.end()
        shown_text = capsys.readouterr().out
        assert "step 1: held-out PSNR 19.00 dB, 4 of 22 views" in shown_text
        assert "PSNR 20.00 dB  20.0 steps/s  held out 19.00 dB (4 of 22 views)" in shown_text
        assert ("evaluate 2 of 4 views" in shown_text) == terminal
        assert shown_text.count("evaluating") == shown_text.count("evaluating 4 views") == (not terminal)


def test_displays_side_by_side_share_their_bars_and_say_which_run_a_line_is_of(capsys):
    shown = Console(width=160, force_terminal=True, color_system=None)
    first = LiveDisplay(shown, label="train.losses=[mse] seed=0")
    second = LiveDisplay(Console(width=160), label="seed=[/1]", beside=first)
    for display in (first, second):
        display.begin(Path("runs/a"), 0, 10)
    capsys.readouterr()
    first.end()
    second.phase("train")
    second.note("still trains")
    assert "seed=[/1]: still trains" in capsys.readouterr().out
    assert second.progress.live.is_started
    second.end()
    assert not second.progress.live.is_started
    shown_text = capsys.readouterr().out
    assert "train.losses=[mse] seed=0: compile" in shown_text
    assert "seed=[/1]: train" in shown_text


def test_views_too_small_for_an_ssim_have_none(capsys):
    summary = {"eval_views": 2, "psnr": 20.0, "ssim": None, "params.total": 3, "train_s": 1.0, "step_ms": 2.0}
    print_outcome(console(), Outcome("a", Path("runs/a"), "finished", summary, ""))
    shown = capsys.readouterr().out
    assert "20.00 dB" in shown
    assert "SSIM" not in shown
