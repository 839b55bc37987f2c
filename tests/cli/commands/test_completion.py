"""Completion, asked in the shells themselves."""

import shutil
import subprocess
from pathlib import Path

import pytest

pytest.importorskip("shtab", reason='needs pip install "qnerf[completion]"')

from qnerf.cli.commands import COMMANDS
from qnerf.cli.commands.completion import parser_of
from qnerf.cli.main import dispatch

ASK = {
    "bash": """source {script}; COMP_WORDS=({words}); COMP_CWORD=$((${{#COMP_WORDS[@]}} - 1))
        $(complete -p qnerf | grep -o -- "-F [^ ]*" | cut -c4-); printf '%s\\n' "${{COMPREPLY[@]}}" """,
    "fish": "source {script}; complete -C '{line}' | string split -f 1 \\t",
}


@pytest.mark.parametrize("shell", ["bash", "fish"])
def test_a_shell_completes_commands_options_choices_and_runs(shell, capsys, tmp_path, monkeypatch):
    if shutil.which(shell) is None:
        pytest.skip(f"{shell} is not installed")
    script = tmp_path / shell
    assert dispatch("completion", [shell]) == 0
    script.write_text(capsys.readouterr().out)
    monkeypatch.chdir(tmp_path)
    for name in ("runs/fox-qcolor-1", "runs/poster-mlp-2", "runs/.index", "elsewhere/chair-3"):
        Path(name).mkdir(parents=True)

    def complete(line: str) -> set[str]:
        *before, last = line.split(" ")[1:]
        words = " ".join(["qnerf", *before, last or "''"])
        question = ASK[shell].format(script=script, words=words, line=line)
        options = ["--norc", "-c"] if shell == "bash" else ["--no-config", "-c"]
        done = subprocess.run([shell, *options, question], capture_output=True, text=True, check=True, timeout=60)
        return set(done.stdout.split())

    assert complete("qnerf rep") >= {"report", "reproduce"}
    assert complete("qnerf show ") == {"fox-qcolor-1", "poster-mlp-2"}
    assert complete("qnerf diff fox-qcolor-1 po") == {"poster-mlp-2"}
    assert complete("qnerf show --store elsewhere ") == {"chair-3"}
    assert complete("qnerf export fox-qcolor-1 --to t") == {"tensorboard"}
    assert complete("qnerf tables --base") == {"--baseline"}
    assert "heads_small" in complete("qnerf run --sweep head")


def test_every_command_has_a_parser_to_complete_from():
    assert all(parser_of(command)._actions for command in COMMANDS)
