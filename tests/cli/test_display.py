"""What the terminal shows of any configuration and any result."""

from pathlib import Path
from typing import Any

import pytest

from qnerf.cli.display import print_outcome
from qnerf.cli.text import console, tree
from qnerf.experiment import Outcome


@pytest.mark.parametrize("value", [r"x\[/b]", "[red]x[/red]", "D:\\data\\", [1, "[/]"], None, "a\nb\x1b[2J"])
def test_a_configuration_is_shown_as_it_is(value: Any, capsys: pytest.CaptureFixture[str]) -> None:
    console().print(tree("configuration", {"scene": {"path": value}}))
    shown = capsys.readouterr().out
    assert f"path: {value}".replace("\n", r"\n").replace("\x1b", r"\x1b") in shown
    assert "\x1b" not in shown


def test_views_too_small_for_an_ssim_have_none(capsys: pytest.CaptureFixture[str]) -> None:
    summary = {"eval_views": 2, "psnr": 20.0, "ssim": None, "params.total": 3, "train_s": 1.0, "step_ms": 2.0}
    print_outcome(console(), Outcome("a", Path("runs/a"), "finished", summary, ""))
    shown = capsys.readouterr().out
    assert "20.00 dB" in shown
    assert "SSIM" not in shown
