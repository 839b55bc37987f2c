"""The commands as a newcomer meets them: the help, mistakes without a traceback, and how they end."""

import io
import re
import subprocess
import sys
from pathlib import Path

import pytest

from qnerf import __version__
from qnerf.cli import main
from qnerf.cli.commands import COMMANDS
from qnerf.cli.errors import exit_code, one_line
from tests.helpers.configs import ROOT


def test_help_has_every_command_once_in_a_short_line(qnerf):
    shown = qnerf("--help")
    assert shown.code == 0
    assert shown == qnerf()
    for name, purpose in COMMANDS.items():
        assert len(re.findall(rf"^  {name} +{re.escape(purpose)}$", shown.out, re.MULTILINE)) == 1
    assert max(map(len, shown.out.splitlines())) <= 100
    assert qnerf("--version").out == f"qnerf {__version__}\n"


def test_help_and_commands_that_read_wait_for_no_large_package():
    code = """if True:
        import sys
        from qnerf.cli.main import usage
        usage()
        print({"pandas"} & {*sys.modules})
        from qnerf.cli.commands import diff, export, rm, runs, show
        print({"torch", "hydra", "numba"} & {*sys.modules})
    """
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout == 2 * "set()\n"


def test_every_command_has_a_help(qnerf):
    for command in COMMANDS.keys() - {"run"}:
        shown = qnerf(command, "--help")
        assert shown.code == 0
        assert shown.out.startswith(f"usage: qnerf {command} ")
        assert "{}" not in shown.out
    for command in ("resume", "reproduce", "render", "view", "probe", "export"):
        assert "scene.path=DIR" in qnerf(command, "--help").out
    shown = qnerf("run", "--help")
    assert "field: classical, qboth, qcolor, qdensity" in shown.out


PAPER = str(ROOT / "docs" / "results" / "paper")
MISTAKES = {
    "fly": "unknown command 'fly'; known: run, ",
    "tabels": "unknown command 'tabels'; did you mean tables? known: run, ",
    "train": "unknown command 'train'; did you mean run? known: run, ",
    "field=qcolor": "did you mean qnerf run?",
    "runs psnr>high": "> compares numbers, got 'high'",
    "runs --limit -1": "--limit",
    "show nobody": "nobody",
    "diff nobody nobody": "nobody",
    "rm nobody --yes": "nobody",
    "export nobody": "nobody",
    "export scene.path=x": "expected a run",
    "export nobody --points 0": "expected a whole number from 1 to",
    "render nobody --size 0x4": "expected a size such as 128x72",
    "render nobody --size 20000x4": "expected a size such as 128x72",
    "render nobody --frames 0": "expected a whole number",
    "resume nobody": "nobody",
    "reproduce nobody": "nobody",
    "probe": "arguments are required: RUN",
    "probe nobody shots=10": "nobody",
    "report nowhere": "nowhere",
    "tables nowhere": "nowhere",
    f"tables {PAPER} --rows no_such_column": "no_such_column",
    f"tables {PAPER} --filter 'open": "'open",
    "figures nowhere": "nowhere",
    f"figures {PAPER} portrait": "portrait",
    "pack nowhere packed": "nowhere",
}


def test_every_command_has_a_help_without_the_extras():
    code = """if True:
        import sys
        sys.modules.update(dict.fromkeys(["optuna", "pycolmap", "imageio_ffmpeg", "starlette", "uvicorn", "viser"]))
        from qnerf.cli.main import COMMANDS, dispatch
        for name in COMMANDS.keys() - {"run"}:
            try:
                sys.exit(f"{name}: {dispatch(name, ['--help'])}")
            except SystemExit as end:
                assert not end.code, end.code
    """
    subprocess.run([sys.executable, "-c", code], check=True, stdout=subprocess.DEVNULL)


def test_a_mistake_is_one_line_with_exit_code_2(qnerf):
    for line, message in MISTAKES.items():
        done = qnerf(*line.split())
        assert (done.code, done.out, done.err.count("\n")) == (2, "", 1), (line, done)
        assert done.err.startswith("error: ")
        assert message in done.err, done.err


def test_probe_names_a_wrong_option(qnerf):
    Path("a-run").mkdir()
    Path("a-run/status.json").write_text("{}")
    for option, message in {
        "shot=3": "unknown option 'shot'; known: shots, noise, p, views, seed",
        "shots=many": "shots[0] expects int, got 'many'",
        "spectra": "unknown probe 'spectra'; known: spectrum",
    }.items():
        done = qnerf("probe", "./a-run", option)
        assert (done.code, message in done.err) == (2, True), done.err


def raising(error):
    def command():
        raise error

    return command


def test_exit_codes(capsys):
    assert exit_code(lambda: None) == 0
    assert exit_code(lambda: 3) == 3
    assert exit_code(raising(KeyboardInterrupt())) == 130
    assert exit_code(raising(ModuleNotFoundError("No module named 's3fs'", name="s3fs"))) == 2
    assert capsys.readouterr().err == "error: No module named 's3fs'\n"
    assert exit_code(raising(MemoryError())) == 1
    for bug in (KeyError("psnr"), ModuleNotFoundError("No module named 'qnerf.no'", name="qnerf.no")):
        with pytest.raises(type(bug)):
            exit_code(raising(bug))


def test_a_closed_pipe_ends_a_command_quietly(tmp_path):
    (tmp_path / "runs").mkdir()
    code = "import sys; from qnerf.cli.main import main; sys.stdin.read(); main()"
    for arguments in (["runs"], ["--help"]):
        process = subprocess.Popen(
            [sys.executable, "-c", code, *arguments], cwd=tmp_path,
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
        )  # fmt: skip
        assert process.stdout is not None
        process.stdout.close()  # before the command writes
        _, told = process.communicate("", timeout=100)
        assert (process.returncode, told) == (141, "")


def test_output_that_knows_only_ascii_gets_the_rest_escaped(tmp_path, monkeypatch):
    (tmp_path / "täst").mkdir()
    monkeypatch.setattr(sys, "stdout", io.TextIOWrapper(written := io.BytesIO(), "ascii"))
    monkeypatch.setattr(sys, "argv", ["qnerf", "runs", "--store", str(tmp_path / "täst")])
    with pytest.raises(SystemExit):
        main.main()
    sys.stdout.flush()
    assert b"t\\xe4st" in written.getvalue()


def test_errors_are_one_line_and_escaped():
    assert one_line(ValueError("a\n  b \x1b[31m\ud800")) == "a b \\x1b[31m\\ud800"
