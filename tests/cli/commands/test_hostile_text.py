"""Names, errors and configurations that somebody else wrote: shown as they are, never obeyed."""

import json

import pandas as pd
import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st

from qnerf.cli.table import Column, plain_lines
from qnerf.cli.text import as_json, styled
from qnerf.records.printable import printable

HOSTILE = (
    "[red]red[/red] [link=http://x]l[/link] [/]\x1b[2J\x1b[1;31mred\x1b]8;;http://x\x1b\\link\x1b]0;title\x07\x9b31m"
    "\x90q\x9cevil\u202etxt.exe\u2066\u200frow\nfake-run  finished\r\x08\v\fzero\u200bwidth\ufeff\u2028\u2029null\x7f"
    ":smile: 100% {x} %s" + "e" + "\u0301" * 30
)


def harmless(text):
    return all(c.isprintable() or c == "\n" for c in text)


@given(text=st.text(st.characters(codec=None)), limit=st.integers(1, 50))
def test_printable_text_is_printable_on_one_line_and_short(text, limit):
    assert printable(text).isprintable()
    assert printable(text, limit).isprintable()
    assert len(printable(text, limit)) <= 10 * limit
    assert printable(printable(text)) == printable(text)
    assert styled(text, "red").plain == printable(text)
    shown = printable(text, lines=True)
    assert harmless(shown)
    assert shown.count("\n") == text.count("\n")


@given(cells=st.lists(st.text(), min_size=1, max_size=5))
def test_a_piped_table_has_one_line_a_row_and_one_word_a_cell(cells):
    columns = [Column("id", lambda row: row["text"]), Column("n", lambda row: str(len(row["text"])), right=True)]
    lines = list(plain_lines(columns, [{"text": text} for text in cells]))
    assert len(lines) == len(cells) + 1
    assert all(line.isprintable() and len(line.split()) == 2 for line in lines)


@given(value=st.recursive(st.text() | st.floats(), lambda inner: st.lists(inner) | st.dictionaries(st.text(), inner)))
def test_json_is_ascii_and_strict(value):
    text = as_json(value)
    assert harmless(text)
    assert text.isascii()

    def refuse(constant):
        raise AssertionError(constant)

    json.loads(text, parse_constant=refuse)


def poison(run):
    """The text in every place of a run's folder that a command shows."""
    text = HOSTILE
    status = json.loads((run / "status.json").read_text())
    (run / "status.json").write_text(json.dumps(status | {"error": text, "host": text, "state": "failed"}))
    (run / "overrides.txt").write_text(f"scene.path={text}\n")
    (run / "environment.json").write_text(
        json.dumps({"git": {"commit": text}, "cpu": {"model": text}, "packages": {text: text}, "host": text})
    )
    config = yaml.safe_load((run / "config.yaml").read_text())
    config["scene"]["path"] = text
    (run / "config.yaml").write_text(yaml.safe_dump(config | {text: {text: text}}))
    pd.DataFrame({"image": [text], "step": [1], "psnr": [20.0]}).to_parquet(run / "eval.parquet")
    (run / text.replace("/", "-")[:100]).write_text("x")


COMMANDS = (
    "show aaaa", "show aaaa --config", "show aaaa --json", "diff aaaa bbbb", "diff aaaa bbbb --json",
    "runs", "runs --json", "runs --columns scene.path",
)  # fmt: skip


@pytest.mark.parametrize("width", [None, 80])
def test_commands_show_hostile_text_and_do_not_obey(store, qnerf, terminal, width):
    (run,) = store.glob("*-aaaaaaaaaa")
    poison(run)
    if width is not None:
        terminal(width)
    for line in COMMANDS:
        done = qnerf(*line.split())
        assert harmless(done.out + done.err), line
        if line == "show aaaa":
            assert "[red]red[/red]" in done.out, line
