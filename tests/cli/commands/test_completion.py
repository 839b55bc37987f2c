"""Completion, asked in the shells themselves."""

import shutil
import subprocess
from pathlib import Path

import pytest

pytest.importorskip("shtab", reason='needs pip install "qnerf[completion]"')

from qnerf.cli.main import dispatch

ASK = {
    "bash": """source {script}; COMP_WORDS=({words}); COMP_CWORD=$((${{#COMP_WORDS[@]}} - 1))
        $(complete -p qnerf | grep -o -- "-F [^ ]*" | cut -c4-); printf '%s\\n' "${{COMPREPLY[@]}}" """,
    "fish": "source {script}; complete -C '{line}' | string split -f 1 \\t",
}


@pytest.mark.parametrize("shell", ["bash", "fish"])
def test_completion_of_commands_options_choices_and_folders(shell, capsys, tmp_path, monkeypatch):
    if shutil.which(shell) is None:
        pytest.skip(f"{shell} is not installed")
    script = tmp_path / shell
    assert dispatch("completion", [shell]) == 0
    script.write_text(capsys.readouterr().out)
    monkeypatch.chdir(tmp_path)
    Path("runs/fox-qcolor-1").mkdir(parents=True)

    def complete(line: str) -> set[str]:
        *before, last = line.split(" ")[1:]
        words = " ".join(["qnerf", *before, last or "''"])
        question = ASK[shell].format(script=script, words=words, line=line)
        options = ["--norc", "-c"] if shell == "bash" else ["--no-config", "-c"]
        done = subprocess.run([shell, *options, question], capture_output=True, text=True, check=True, timeout=60)
        return {word.rstrip("/") for word in done.stdout.split()}

    assert complete("qnerf rep") >= {"report", "reproduce"}
    assert complete("qnerf show runs/") == {"runs/fox-qcolor-1"}
    assert complete("qnerf export runs/fox-qcolor-1 --to t") == {"tensorboard"}
    assert "heads_small" in complete("qnerf run --sweep head")
