"""Names, tags, notes, errors and configurations that somebody else wrote: shown as they are, never obeyed."""

import json
import os
from pathlib import Path

import pandas as pd
import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st
from rich.text import Text

from qnerf.cli.table import Column, plain_lines, table
from qnerf.cli.text import as_json, styled
from qnerf.records import runs
from qnerf.records.printable import printable

HOSTILE = [
    "[red]red[/red] [link=http://x]l[/link] [/]",
    "\x1b[2J\x1b[1;31mred",
    "\x1b]8;;http://x\x1b\\link\x1b]8;;\x1b\\",
    "\x1b]0;title\x07",
    "\x9b31m\x90q\x9c",
    "evil\u202etxt.exe\u2066\u200f",
    "row\nfake-run  finished\r\x08\x08\v\f",
    "zero\u200bwidth\ufeff\u2028\u2029",
    "null\x00\x7f\ud800",
    ":smile: 100% {x} %s",
    "e" + "\u0301" * 30,
]


def harmless(text: str) -> bool:
    return all(c.isprintable() or c == "\n" for c in text)


@given(text=st.text(st.characters(codec=None)), limit=st.integers(1, 50))
def test_printable_text_is_printable_on_one_line_and_short(text, limit):
    assert printable(text).isprintable()
    assert printable(text, limit).isprintable()
    assert len(printable(text, limit)) <= 10 * limit
    assert printable(printable(text)) == printable(text)
    shown = printable(text, lines=True)
    assert harmless(shown)
    assert shown.count("\n") == text.count("\n")


@given(text=st.text(alphabet=st.characters(categories=["L", "N", "P", "S"])))
def test_what_is_printable_stays_as_it_is(text):
    assert printable(text) == text


@given(text=st.text())
def test_a_styled_text_is_no_markup(text):
    assert styled(text, "red").plain == Text(printable(text)).plain


@given(cells=st.lists(st.text(), min_size=1, max_size=5), width=st.integers(10, 100))
def test_a_table_has_one_line_a_row_of_printable_text(cells, width):
    columns = [
        Column("id", lambda row: row["text"], min_width=10),
        Column("n", lambda row: str(len(row["text"])), right=True),
    ]
    rows = [{"text": text} for text in cells]
    for lines in ([line.plain for line in table(columns, rows, width)], list(plain_lines(columns, rows))):
        assert len(lines) == len(rows) + 1
        assert all(line.isprintable() for line in lines)
    assert all(len(line.split(" ")) >= 2 and len(line.split()) == 2 for line in plain_lines(columns, rows))


@given(value=st.recursive(st.text() | st.floats(), lambda inner: st.lists(inner) | st.dictionaries(st.text(), inner)))
def test_json_is_ascii_and_strict(value):
    text = as_json(value)
    assert harmless(text)
    assert text.isascii()

    def refuse(constant: str) -> None:
        raise AssertionError(constant)

    json.loads(text, parse_constant=refuse)


@pytest.fixture(params=HOSTILE, ids=range(len(HOSTILE)))
def text(request: pytest.FixtureRequest) -> str:
    return str(request.param)


def poison(run: Path, text: str) -> None:
    """The text in every place of a run's folder that a command shows."""
    encoded = text.encode("utf-8", "replace").decode()
    (run / "annotations.json").write_text(json.dumps({"tags": [text, "fine"], "note": f"{text}\n{text}"}))
    status = json.loads((run / "status.json").read_text())
    (run / "status.json").write_text(json.dumps(status | {"error": text, "host": text, "state": "failed"}))
    (run / "overrides.txt").write_text(f"scene.path={encoded}\n")
    (run / "environment.json").write_text(
        json.dumps({"git": {"commit": text}, "cpu": {"model": text}, "packages": {text: text}, "host": text})
    )
    config = yaml.safe_load((run / "config.yaml").read_text())
    config["scene"]["path"] = encoded
    (run / "config.yaml").write_text(yaml.safe_dump(config | {encoded: {encoded: encoded}}))
    pd.DataFrame({"image": [encoded], "step": [1], "psnr": [20.0]}).to_parquet(run / "eval.parquet")
    name = encoded.replace("/", "-").replace("\0", "")
    (run / name).write_text("x")


COMMANDS = (
    "show aaaa", "show aaaa --config", "show aaaa --json", "diff aaaa bbbb", "diff aaaa bbbb --json", "tag aaaa",
    "note aaaa", "tag aaaa --remove x", "runs", "runs --json", "runs --columns scene.path", "watch aaaa --once",
)  # fmt: skip


def test_commands_show_it_and_do_not_obey(store, qnerf, terminal, text):
    (run,) = store.glob("*-aaaaaaaaaa")
    poison(run, text)
    for width in (None, 80):
        if width is not None:
            terminal(width)
        for line in COMMANDS:
            done = qnerf(*line.split())
            assert harmless(done.out + done.err), line
            if "[red]" in text and line in ("show aaaa", "note aaaa", "tag aaaa"):
                assert "[red]red[/red]" in done.out, line


@pytest.mark.parametrize(
    "line", ["runs", "show aaaa", "diff aaaa bbbb", "watch aaaa --once", "runs --sort psnr", "runs psnr>1"]
)
def test_values_of_other_types_than_a_run_writes(store, qnerf, line):
    (run,) = store.glob("*-aaaaaaaaaa")
    row = pd.read_parquet(run / "summary.parquet").astype(object)
    for name, value in {"psnr": "high", "params.total": "many", "params.color": None, "train_s": [1.0]}.items():
        row[name] = [value]
    row.to_parquet(run / "summary.parquet")
    status = json.loads((run / "status.json").read_text())
    (run / "status.json").write_text(json.dumps(status | {"step": [1], "created": "x", "heartbeat": {}, "error": 5}))
    done = qnerf(*line.split())
    assert done.code == 0, done.err
    assert run.name in done.out or ">" in line


@pytest.mark.skipif(os.name == "nt", reason="such names do not exist there")
def test_a_run_with_a_hostile_name(store, qnerf, terminal, text):
    name = text.encode("utf-8", "replace").decode().replace("/", "-").replace("\0", "")
    (run,) = store.glob("*-aaaaaaaaaa")
    run.rename(store / name)
    for arguments in (["runs"], ["runs", "--json"], ["runs", "--ids"], ["show", store / name], ["watch", "--once"]):
        done = qnerf(*arguments)
        assert done.code == 0, done.err
        assert harmless(done.out)
    terminal(80)
    assert harmless(qnerf("runs").out)
    done = qnerf("rm", store / name, "--yes")
    assert done.code == 0
    assert harmless(done.out)
    assert len(runs(store)) == 4
