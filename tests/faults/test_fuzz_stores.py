"""Mutated stores through the console commands; QNERF_FAULTS=full runs 5,000 of them, about a second each.

Each case runs a third of the commands, another third in each case, and a report or figures in every twentieth.
"""

import os
import random
import subprocess
import sys
from pathlib import Path

import pytest

from qnerf import records
from tests.faults.fuzz_case import CONTROLS, Case, snapshot
from tests.faults.fuzz_stores import formula
from tests.faults.mutations import MUTATIONS, Skipped, Store
from tests.helpers.configs import ROOT
from tests.helpers.spoiled import interrupted

FULL = os.environ.get("QNERF_FAULTS") == "full"
CASES = 5000 if FULL else 4

FAILED: tuple[str, ...] = ("7 link_folder:7", "1065 forged_index:192077", "2 forged_index:2")
"""Cases that failed once, as the fuzzer prints them."""


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="the fuzzer watches its processes through /proc")
def test_no_mutated_store_ends_a_command_badly() -> None:
    arguments = [f"--case={case}" for case in FAILED]
    done = subprocess.run(
        [
            sys.executable,
            "-m",
            "tests.faults.fuzz_stores",
            f"--cases={CASES}",
            "--quick",
            *arguments,
        ],
        cwd=ROOT,
        env=os.environ | {"OMP_NUM_THREADS": "1"},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, f"{done.stdout}{done.stderr[-4000:]}"
    assert f"{CASES + len(FAILED)} cases, 0 failed" in done.stdout


@pytest.mark.parametrize("name", MUTATIONS)
def test_a_mutation_changes_the_same_every_time_and_nothing_outside(name: str, tmp_path: Path) -> None:
    described = []
    for copy in ("one", "two"):
        folder = tmp_path / copy
        interrupted(folder, "run")
        (folder / "outside").mkdir()
        (folder / "outside" / "file").write_text("kept")
        before = snapshot(folder / "outside")
        store = Store(folder / "runs", folder / "outside")
        try:
            described.append(MUTATIONS[name](store, random.Random(3)))
        except Skipped:
            described.append("skipped")
        assert snapshot(folder / "outside") == before
    assert described[0].replace(str(tmp_path / "one"), "") == described[1].replace(str(tmp_path / "two"), "")


def test_a_case_is_printed_as_it_is_read() -> None:
    case = Case.of(17)
    assert Case.parse(str(case)) == case == Case.parse("17")
    assert Case.parse("3 link:8 cut:1") == Case(3, (("link", 8), ("cut", 1)))


def test_a_snapshot_tells_every_change(tmp_path: Path) -> None:
    run = interrupted(tmp_path)
    before = snapshot(tmp_path)
    assert snapshot(tmp_path) == before
    status = run / "status.json"
    moment = status.stat().st_mtime_ns
    status.write_bytes(status.read_bytes().replace(b"interrupted", b"interruptex"))
    os.utime(status, ns=(moment, moment))
    assert snapshot(tmp_path) != before
    assert records.state(run) == "interrupted"


def test_what_a_terminal_or_a_spreadsheet_would_act_on_is_seen() -> None:
    assert all(CONTROLS.search(text) for text in ("\x1b[31m", "a\rb", "\x9b1m", "\u202e", "\x00", "\x7f"))
    assert not CONTROLS.search("a\tb\nä ± ٣ \U0001f986")
    assert formula(b"a,b\n1,=cmd|x\n") == "=cmd|x"
    assert formula(b'a,"x\n=y"\n-1.5,+2,-inf,\'=1\n') == ""
