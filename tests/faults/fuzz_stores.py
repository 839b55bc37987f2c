"""Mutated stores through the console commands.

    python -m tests.faults.fuzz_stores --seed 0 --cases 5000     cases 0 to 4999
    python -m tests.faults.fuzz_stores --case "17 link:8123"     one case again, as a failure prints it

A case is a copy of a small store of real runs with a few changes out of `tests.faults.mutations`. Every command then
runs on it, in a forked process that has everything imported. A command must end within ten seconds, with an exit code
that it declares, without an exception, and without control characters in what it prints. Nothing outside the store may
be read into its output or changed. A failure is tried again with each of its mutations alone, and printed with those
that are needed. Exit code: 1 if any case failed.

A case takes about three seconds, with --quick one. The report draws one or two of its figures, another choice in each
case.
"""

import argparse
import collections
import contextlib
import csv
import importlib
import io
import json
import os
import re
import select
import shutil
import signal
import sys
import tempfile
import time
import traceback
import warnings
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, NoReturn

from tests.faults.fuzz_case import (
    FORMULA,
    OURS,
    SECONDS,
    SECRET,
    Case,
    Failure,
    Wanted,
    attend,
    commands,
    console,
    every,
    quick,
    snapshot,
    write_template,
)
from tests.faults.mutations import MARK


class Fuzzer:
    """Makes the template once, then forks a process for every case."""

    def __init__(self, base: Path) -> None:
        self.base = base
        self.seconds: collections.Counter[str] = collections.Counter()
        with open(os.devnull, "w") as null, contextlib.redirect_stdout(null), contextlib.redirect_stderr(null):
            if trained := not (base / "kept").is_dir():
                write_template(base)
                shutil.copytree(base / "outside", base / "kept", symlinks=True)
            self._import_everything(trained)
        self.pristine = snapshot(base / "outside")

    def _import_everything(self, trained: bool) -> None:
        """What the commands import, before the fork. The first figure and the first training start slowly.

        trained: whether this process has trained already.
        """
        work = self.base / "warm"
        work.mkdir()
        with contextlib.chdir(work):
            shutil.copytree(self.base / "store", work / "store", symlinks=True)
            if not trained:
                (interrupted,) = work.glob("store/*-s2-*")
                console("resume", interrupted)
            for arguments in commands(0, work / "store", (), ["capacity"]):
                if arguments[0] in ("runs", "show", "diff", "tables", "export"):
                    console(*arguments)
            console("figures", work / "store", "capacity", "--formats=svg,png,pdf")
            for module in ("__main__", "content", "curves", "page", "parts", "pictures"):
                importlib.import_module(f"qnerf.analysis.report.{module}")
        shutil.rmtree(work)

    def failures(self, case: Case, wanted: Wanted = every) -> tuple[list[str], list[Failure]]:
        """What was changed, and what went wrong."""
        folder = self.base / "case"
        folder.mkdir()
        try:
            what, linked, found = self._supervised(case, folder, wanted)
            found += self._aftermath(folder, linked)
        finally:
            shutil.rmtree(folder, onerror=_make_removable)
        return what, found

    def _supervised(self, case: Case, folder: Path, wanted: Wanted) -> tuple[list[str], bool, list[Failure]]:
        read, write = os.pipe()
        sys.stdout.flush()
        pid = os.fork()
        if pid == 0:
            os.close(read)
            _attend_and_exit(case, self.base, folder, write, wanted)
        os.close(write)
        case_so_far = _Messages(case, self.seconds)
        clock = _Clock(pid)
        with os.fdopen(read, "rb", buffering=0) as lines:
            while True:
                if select.select([lines], [], [], 0.2)[0]:
                    data = lines.read(2**16)
                    if not data:
                        break
                    case_so_far.take(data)
                    clock.restart()
                elif case_so_far.command and (reason := clock.expired()):
                    os.kill(pid, signal.SIGUSR1)
                    time.sleep(0.5)
                    stack = (folder / "err").read_text(errors="replace")[-3000:]
                    os.kill(pid, signal.SIGKILL)
                    case_so_far.fail("hang", _innermost(stack), f"{reason}: {stack[:600]}")
                    break
        ended = os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1])
        if ended != 0 and not any(failure.kind == "hang" for failure in case_so_far.found):
            text = (folder / "err").read_text(errors="replace")[-500:] if (folder / "err").exists() else ""
            case_so_far.fail("crash", f"exit {ended} in {case_so_far.command.partition(' ')[0]}", text)
        return case_so_far.changes, case_so_far.linked, case_so_far.found

    def _aftermath(self, folder: Path, linked: bool) -> Iterator[Failure]:
        """What the commands left: outside the store, and in their own pages and tables."""
        now = snapshot(self.base / "outside")
        changed = sorted(path for path in now.keys() | self.pristine.keys() if now.get(path) != self.pristine.get(path))
        if changed:
            yield Failure(
                "", "outside", f"{changed[0].split('/')[0]}/.../{Path(changed[0]).name}", f"changed: {changed[:6]}"
            )
            shutil.rmtree(self.base / "outside")
            shutil.copytree(self.base / "kept", self.base / "outside")
            self.pristine = snapshot(self.base / "outside")
        entries = {path.name for path in folder.iterdir()} - {"store", "work", "cache", "out", "err"}
        entries |= {path.name for path in self.base.iterdir()} - {"store", "outside", "kept", "case"}
        entries |= {path.name for path in (folder / "work").iterdir()} - {"report", "figures", "packed", "exports"}
        if entries:
            yield Failure("", "outside", "new entries", f"new: {sorted(entries)}")
        for path in sorted((folder / "work").rglob("*")):
            if path.is_symlink() or not path.is_file() or path.suffix not in (".html", ".svg", ".csv", ".md"):
                continue
            data = path.read_bytes()
            if SECRET.encode() in data and not linked:
                yield Failure("", "secret", path.suffix, f"in {path.name}")
            if path.suffix != ".csv" and f"<{MARK}".encode() in data:
                yield Failure("", "html", path.suffix, f"in {path.name}")
            if path.suffix == ".csv" and (cell := formula(data[: 2**20])):
                yield Failure("", "formula", path.name, ascii(cell)[:200])


def _attend_and_exit(case: Case, base: Path, folder: Path, pipe: int, wanted: Wanted) -> NoReturn:
    def tell(message: dict[str, Any]) -> None:
        os.write(pipe, f"{json.dumps(message)}\n".encode())

    code = 1
    try:
        attend(case, base, folder, tell, wanted)
        code = 0
    except BaseException:
        tell({"harness": traceback.format_exc()[-1500:]})
    finally:
        os._exit(code)


class _Messages:
    """What the process of a case has told so far."""

    def __init__(self, case: Case, seconds: "collections.Counter[str]") -> None:
        self.case, self.seconds = case, seconds
        self.changes: list[str] = []
        self.found: list[Failure] = []
        self.linked, self.command, self.rest = False, "", b""

    def take(self, data: bytes) -> None:
        *lines, self.rest = (self.rest + data).split(b"\n")
        for message in map(json.loads, lines):
            if "harness" in message:
                raise AssertionError(f"case {self.case}: {message['harness']}")
            self.changes = message.get("changes", self.changes)
            self.linked = message.get("linked", self.linked)
            self.command = message.get("begin", self.command)
            if "failure" in message:
                self.found.append(Failure(**message["failure"]))
            if "end" in message:
                self.seconds[message["end"]] += message["seconds"]

    def fail(self, kind: str, where: str, text: str) -> None:
        self.found.append(Failure(self.command, kind, where, text))


class _Clock:
    """How long a command has worked or waited. A process that only gets no processor does neither."""

    def __init__(self, pid: int) -> None:
        self.pid = pid
        self.restart()

    def restart(self) -> None:
        self.begin = self.idle_since = time.monotonic()
        self.cpu = self.last = self._cpu()[1]

    def expired(self) -> str:
        state, cpu = self._cpu()
        now = time.monotonic()
        if cpu != self.last or state == "R":
            self.last, self.idle_since = cpu, now
        if cpu - self.cpu > SECONDS:
            return f"more than {SECONDS:g} s of work"
        if now - self.begin > SECONDS and now - self.idle_since > SECONDS / 2:
            return f"waiting for more than {SECONDS:g} s"
        return f"more than {20 * SECONDS:g} s" if now - self.begin > 20 * SECONDS else ""

    def _cpu(self) -> tuple[str, float]:
        fields = Path(f"/proc/{self.pid}/stat").read_text().rpartition(")")[2].split()
        return fields[0], sum(map(int, fields[11:15])) / os.sysconf("SC_CLK_TCK")


def _innermost(stack: str) -> str:
    """Where a process was, from faulthandler's list of its frames, the innermost first."""
    frames = re.findall(r'File "(.*?)", line (\d+) in (\w+)', stack)
    ours = [frame for frame in frames if frame[0].startswith(OURS)]
    return " < ".join(f"{'/'.join(Path(file).parts[-2:])}:{line} {name}" for file, line, name in ours[:2])


def formula(data: bytes) -> str:
    """The first cell of a CSV that a spreadsheet would calculate; empty if there is none."""
    csv.field_size_limit(2**24)
    with contextlib.suppress(csv.Error):
        for row in csv.reader(io.StringIO(data.decode(errors="replace"), newline="")):
            for cell in row:
                if FORMULA.match(cell):
                    return cell
    return ""


def _make_removable(function: Callable[[str], object], path: str, _: object) -> None:
    with contextlib.suppress(OSError):
        os.chmod(os.path.dirname(path), 0o700)
        function(path)


def minimal(fuzzer: Fuzzer, case: Case, failures: Sequence[Failure], wanted: Wanted) -> Case:
    """The case with only one of its mutations, if one is enough for one of the failures."""
    causes = {failure.cause for failure in failures}
    if len(case.mutations) > 1:
        for one in case.mutations:
            single = Case(case.seed, (one,))
            if causes & {failure.cause for failure in fuzzer.failures(single, wanted)[1]}:
                return single
    return case


def fuzz(cases: Sequence[Case], base: Path, wanted: Wanted = every, say: Callable[[str], None] = print) -> int:
    """Runs all cases with a template in the folder `base`; returns how many failed."""
    causes: dict[tuple[str, str], list[str]] = collections.defaultdict(list)
    failed = 0
    begin = time.monotonic()
    fuzzer = Fuzzer(base)
    prepared = time.monotonic()
    for number, case in enumerate(cases):
        if number and number % 100 == 0:
            say(f"after {number} cases: {failed} failed")
        changes, failures = fuzzer.failures(case, wanted)
        if failures:
            failed += 1
            case = minimal(fuzzer, case, failures, wanted)
            changes, failures = fuzzer.failures(case, wanted)
            say("\n    ".join([f"case {case}", *changes]))
        for failure in failures:
            causes[failure.cause].append(str(case))
            say(f"  {failure.kind}: {failure.command} | {failure.where}\n    {failure.text}".replace(f"{base}/", ""))
    for (kind, where), examples in sorted(causes.items(), key=lambda item: -len(item[1])):
        say(f"{len(examples):5d} {kind}: {where}   e.g. --case {examples[0]!r}")
    spent = ", ".join(f"{name} {seconds / max(len(cases), 1):.2f}" for name, seconds in fuzzer.seconds.most_common())
    took = (time.monotonic() - prepared) / max(len(cases), 1)
    say(f"template {prepared - begin:.0f} s, a case {took:.1f} s; work of its commands in seconds: {spent}")
    say(f"{len(cases)} cases, {failed} failed, {len(causes)} causes")
    return failed


def command_line() -> int:
    parser = argparse.ArgumentParser(description="Mutated stores through the console commands.")
    parser.add_argument("--seed", type=int, default=0, help="of the first case (default: %(default)s)")
    parser.add_argument("--cases", type=int, default=0, help="how many (default: %(default)s)")
    parser.add_argument(
        "--case", action="append", default=[], help="'SEED NAME:NUMBER ...' as a failure prints it; repeatable"
    )
    parser.add_argument("--command", help="only this command")
    parser.add_argument("--quick", action="store_true", help="a third of the commands in each case")
    parser.add_argument("--template", type=Path, metavar="DIR", help="where the template is, or will be kept")
    options = parser.parse_args()
    warnings.simplefilter("ignore")
    seeds = range(options.seed, options.seed + options.cases)
    cases = [*map(Case.parse, options.case), *map(Case.of, seeds)]
    with tempfile.TemporaryDirectory(prefix="qnerf-fuzz-") as folder:
        # Without symbolic links in the path, so that messages and files name the same one.
        base = (options.template or Path(folder)).resolve()
        wanted = quick if options.quick else every
        if options.command:
            wanted = lambda case, command: command == options.command  # noqa: E731
        failed = fuzz(cases, base, wanted, lambda line: print(line, flush=True))
    return int(failed > 0)


if __name__ == "__main__":
    sys.exit(command_line())
