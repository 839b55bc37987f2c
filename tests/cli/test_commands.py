"""The commands as a newcomer meets them: the help, sweeps by name, former names, and mistakes without a traceback."""

import importlib
import re
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from qnerf import __version__
from qnerf.cli import main
from qnerf.cli.commands import ANALYSIS, COMMANDS, RENAMED
from qnerf.cli.errors import exit_code
from qnerf.cli.sweep import expand_sweep
from qnerf.config.folders import CONF, SWEEPS
from tests.helpers.configs import ROOT

Call = Callable[..., tuple[int, str, str]]


@pytest.fixture
def call(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> Call:
    """`call("show", "RUN")`: exit code, output and standard error of `qnerf show RUN`."""

    def run(*arguments: str) -> tuple[int, str, str]:
        monkeypatch.setattr(sys, "argv", ["qnerf", *arguments])
        code = 0
        try:
            main.main()
        except SystemExit as stop:
            code = int(stop.code or 0)
        out, err = capsys.readouterr()
        return code, out, err

    return run


def test_help_has_every_command_once_in_a_short_line(call: Call) -> None:
    code, shown, _ = call("--help")
    assert code == 0
    assert (code, shown) == call()[:2]
    for name, purpose in COMMANDS.items():
        assert len(re.findall(rf"^  {name} +{re.escape(purpose)}$", shown, re.MULTILINE)) == 1
    assert max(map(len, shown.splitlines())) <= 100


def test_help_waits_for_no_large_package() -> None:
    code = "import sys; from qnerf.cli.main import usage; usage(); print({'torch', 'pandas', 'hydra'} & {*sys.modules})"
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout == "set()\n"


@pytest.mark.parametrize("command", [name for name in COMMANDS if name != "run"])
def test_every_command_has_a_help(call: Call, command: str) -> None:
    code, shown, _ = call(command, "--help")
    assert code == 0
    assert shown.startswith(f"usage: qnerf {command} ")
    assert "{}" not in shown


@pytest.mark.parametrize("command", ANALYSIS)
def test_in_a_checkout_help_names_the_module(capsys: pytest.CaptureFixture[str], command: str) -> None:
    with pytest.raises(SystemExit):
        importlib.import_module(f"analysis.{ANALYSIS[command]}").main(["--help"])
    assert capsys.readouterr().out.startswith(f"usage: qnerf {command} ")


def test_the_version(call: Call) -> None:
    assert call("--version") == (0, f"qnerf {__version__}\n", "")


def test_a_former_name_still_works_and_says_the_new_one(call: Call) -> None:
    for old, new in RENAMED.items():
        code, shown, told = call(old, "--help")
        assert code == 0
        assert shown.startswith(f"usage: qnerf {new} ")
        assert told == f"note: `qnerf {old}` is now called `qnerf {new}`\n"


def test_a_sweep_by_name_is_a_file_that_hydra_finds() -> None:
    for file in SWEEPS.glob("*.yaml"):
        expected = ["-cd", str(SWEEPS), "-cn", file.stem, "budget=short"]
        assert expand_sweep(["--sweep", file.stem, "budget=short"]) == expected
        assert expand_sweep([f"--sweep={file.stem}", "budget=short"]) == expected
    assert (CONF / "config.yaml").is_file()


def test_a_sweep_may_be_the_users_own_file(tmp_path: Path) -> None:
    (tmp_path / "mine.yaml").write_text("seed: 1\n")
    assert expand_sweep(["--sweep", str(tmp_path / "mine.yaml")]) == ["-cd", str(tmp_path), "-cn", "mine"]


@pytest.mark.parametrize("arguments", [["--sweep", "sedes"], ["--sweep"], ["--sweep="], ["--sweep", "none.yaml"]])
def test_a_wrong_sweep_is_answered_with_the_known_ones(call: Call, arguments: list[str]) -> None:
    code, _, told = call("run", *arguments)
    assert code == 2
    assert told.count("\n") == 1
    assert "known: ansatz, both_table, control" in told


MISTAKES = [
    ["fly"],
    ["runs", "psnr>high"],
    ["runs", "--limit", "-1"],
    ["show", "nobody"],
    ["diff", "nobody", "nobody"],
    ["watch", "nobody"],
    ["tag", "nobody", "good"],
    ["note", "nobody", "text"],
    ["rm", "nobody", "--yes"],
    ["export", "nobody", "--to", "csv"],
    ["resume", "nobody"],
    ["reproduce", "nobody"],
    ["probe", "nobody", "shots=10"],
    ["report", "nowhere"],
    ["tables", "nowhere"],
    ["tables", str(ROOT / "docs" / "results" / "paper"), "--rows", "no_such_column"],
    ["tables", str(ROOT / "docs" / "results" / "paper"), "--filter", "'open"],
    ["figures", "nowhere"],
    ["figures", str(ROOT / "docs" / "results" / "paper"), "portrait"],
    ["hsv", "nowhere"],
    ["hsv", str(ROOT / "docs" / "results" / "paper")],
    ["pack", "nowhere", "packed"],
    ["results", "nowhere"],
]


@pytest.mark.parametrize("arguments", MISTAKES, ids=" ".join)
def test_a_mistake_is_one_line(
    call: Call, monkeypatch: pytest.MonkeyPatch, tmp_path: Path, arguments: list[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    code, out, told = call(*arguments)
    assert code == 2
    assert out == ""
    assert told.startswith("error: ")
    assert told.count("\n") == 1


def test_how_a_command_ends(capsys: pytest.CaptureFixture[str]) -> None:
    def failing(error: BaseException) -> Callable[[], int | None]:
        def command() -> None:
            raise error

        return command

    assert exit_code(lambda: None) == 0
    assert exit_code(lambda: 3) == 3
    assert exit_code(failing(KeyboardInterrupt())) == 130
    assert exit_code(failing(ModuleNotFoundError("No module named 's3fs'", name="s3fs"))) == 2
    assert capsys.readouterr().err == "error: No module named 's3fs'\n"
    for bug in (KeyError("psnr"), ModuleNotFoundError("No module named 'qnerf.no'", name="qnerf.no")):
        with pytest.raises(type(bug)):
            exit_code(failing(bug))


@pytest.mark.parametrize("arguments", [["runs"], ["run", "--help"], ["--help"], ["--version"]])
def test_a_closed_pipe_ends_a_command_quietly(tmp_path: Path, arguments: list[str]) -> None:
    for name in (f"r{number}" for number in range(3)):
        (tmp_path / "runs" / name).mkdir(parents=True)
    code = "import os, sys; from qnerf.cli.main import main; sys.stdin.read(); main()"
    process = subprocess.Popen(
        [sys.executable, "-c", code, *arguments], cwd=tmp_path,
        stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
    )  # fmt: skip
    assert process.stdout is not None
    process.stdout.close()  # before the command writes
    _, told = process.communicate("", timeout=100)
    assert process.returncode == 141, told
    assert told == ""
