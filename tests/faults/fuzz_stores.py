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
import dataclasses
import faulthandler
import hashlib
import importlib
import io
import json
import os
import random
import re
import resource
import select
import shutil
import signal
import sys
import tempfile
import time
import traceback
import warnings
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NoReturn

import numpy as np
from PIL import Image

from qnerf import experiment, records
from qnerf.cli import main
from qnerf.probes import load, probe
from qnerf.probes.shots_and_noise import evaluate_hardware, grid
from qnerf.records import annotations, index, owner
from qnerf.records.index import locations
from tests.faults.mutations import MARK, MUTATIONS, Skipped, Store
from tests.helpers.configs import ROOT, TINY, composed
from tests.helpers.scenes import write_scene

SECONDS = 10.0  # a command's limit; of its own work, or of waiting for something
MEMORY = 4 * 2**30  # bytes of address space beyond what the process has at the start
EXIT_CODES = (0, 1, 2)
OURS = (str(ROOT / "src"), str(ROOT / "analysis"))
SECRET = "outside-secret"
CONTROLS = re.compile("[\x00-\x08\x0b-\x1f\x7f-\x9f\u202a-\u202e\u2066-\u2069\ufffd]")
FORMULA = re.compile(r"[=@]|[+-](?![\d.]|inf|nan)")

STEPS = 4
SETTINGS = (
    *TINY, "hash=C7", "hash.log2_table_size=6", "scene=nerfstudio", f"train.steps={STEPS}", "train.rays=8",
    "train.eval_every=0", "train.log_every=1", "train.checkpoint_every=0", "device=cpu", "threads=1",
)  # fmt: skip


@dataclass(frozen=True)
class Case:
    """seed: chooses the commands' options. mutations: names and seeds of the changes, in order."""

    seed: int
    mutations: tuple[tuple[str, int], ...]

    @classmethod
    def of(cls, seed: int) -> "Case":
        rng = random.Random(seed)
        names = rng.choices(sorted(MUTATIONS), k=rng.choice((1, 1, 1, 2, 3, 6)))
        return cls(seed, tuple((name, rng.randrange(10**6)) for name in names))

    @classmethod
    def parse(cls, text: str) -> "Case":
        """`SEED` or `SEED NAME:NUMBER ...`; the inverse of str."""
        seed, *names = text.split()
        pairs = (name.split(":") for name in names)
        return cls(int(seed), tuple((name, int(number)) for name, number in pairs)) if names else cls.of(int(seed))

    def __str__(self) -> str:
        return " ".join([str(self.seed), *(f"{name}:{number}" for name, number in self.mutations)])


@dataclass(frozen=True)
class Failure:
    """One thing that went wrong. kind: such as exception, hang, crash, secret, outside. where: for grouping."""

    command: str
    kind: str
    where: str
    text: str

    @property
    def cause(self) -> tuple[str, str]:
        return self.kind, self.where or self.command.partition(" ")[0]


Wanted = Callable[[Case, str], bool]
"""Whether a case runs the command of this name."""


def every(case: Case, command: str) -> bool:
    return True


def quick(case: Case, command: str) -> bool:
    """A third of the commands, another one in each case; those that take long less often."""
    share = 0.05 if command in ("report", "figures") else 0.3
    return random.Random(f"{case.seed} {command}").random() < share


# The store that is changed


class _Stop(experiment.Display):
    def __init__(self, error: BaseException) -> None:
        self.error = error

    def step(self, step: int, metrics: Any) -> None:
        if step == STEPS // 2:
            raise self.error


def write_template(base: Path) -> None:
    """`base/store` with four runs, and `base/outside`: the scene, a copy of the store and other files, with secrets."""
    outside, store = base / "outside", base / "store"
    scene = write_scene(outside / "scene", views=4)
    path = f"scene.path={scene}"
    runs = []
    for field in ("classical", "qcolor"):
        runs.append(
            experiment.run(composed(*SETTINGS, path, f"field={field}", f"store={store}"), ["field=qcolor"]).path
        )
    for seed, error in enumerate((RuntimeError("loss is nan at step 2"), KeyboardInterrupt()), start=1):
        config = composed(*SETTINGS, path, "field=qcolor", f"seed={seed}", "hash=auto", f"store={store}")
        with contextlib.suppress(RuntimeError, KeyboardInterrupt):
            experiment.run(config, display=_Stop(error))
    for run, names in zip(runs, (("units", "rays", "encoding"), ("units", "spectrum")), strict=True):
        trained = load(run, None)
        for name in names:
            probe(trained, name)
    evaluate_hardware(trained, grid([10], "depolarizing", [], 0), views=1, tell=lambda line: None)
    for run in runs:
        console("tag", run, "good,baseline")
        console("note", run, "worse at the edges\nof the second view")
    index.load(store)
    copy = outside / "store"
    shutil.copytree(store, copy)
    for run in records.runs(copy):
        environment = json.loads((run / "environment.json").read_text())
        (run / "environment.json").write_text(json.dumps(environment | {"host": SECRET}))
        (run / "annotations.json").write_text(json.dumps({"tags": [SECRET], "note": SECRET}))
        (run / "log.txt").write_text(f"{SECRET}\n")
        (run / ".tmp").mkdir()
    for name in ("old-work", "old-x", "new-x"):
        (copy / ".tmp" / name).mkdir(parents=True)
        (copy / ".tmp" / name / "file").write_text(SECRET)
    numbered = outside / "numbered"
    numbered.mkdir()
    for number in range(3):
        (numbered / f"{number:06d}.json").write_text(json.dumps({"note": SECRET}))
    (numbered / "old-work").mkdir()
    (outside / "text.txt").write_text(SECRET)
    (outside / "object.json").write_text(json.dumps({"host": SECRET, "note": SECRET, "tags": [SECRET]}))
    (outside / "config.yaml").write_text(f"a: {SECRET}\n")
    Image.fromarray(np.full((6, 8, 3), 200, np.uint8)).save(outside / "picture.png")


def console(*arguments: object) -> int | str | None:
    """Runs `qnerf ARGUMENTS` in this process; returns its exit code."""
    sys.argv = ["qnerf", *map(str, arguments)]
    try:
        main.main()
    except SystemExit as end:
        return end.code
    return 0


def snapshot(folder: Path) -> dict[str, tuple[Any, ...]]:
    """Everything below a folder: type, modification time and content."""
    found = {}
    for path in [folder, *sorted(folder.rglob("*"))]:
        status = path.lstat()
        content = hashlib.sha1(path.read_bytes()).hexdigest() if path.is_file() else ""
        found[str(path.relative_to(folder))] = (status.st_mode, status.st_mtime_ns, content)
    return found


# The commands


def commands(seed: int, store: Path, targets: Sequence[str], figures: Sequence[str]) -> Iterator[list[str]]:
    """`qnerf` commands for a store, the ones that change it last; `targets` are the runs to look at."""
    rng = random.Random(seed)
    names = sorted(name for name in os.listdir(store) if not name.startswith("."))
    hit = [name for name in dict.fromkeys(targets) if name in names] or names or ["nothing"]
    target, other, third = rng.choice(hit), rng.choice(names or ["nothing"]), rng.choice(names or ["nothing"])
    interrupted = rng.choice((target, *(name for name in names if "-s2-" in name)))

    def run(name: str) -> list[str]:
        return [str(store / name)] if rng.random() < 0.5 else [name, f"--store={store}"]

    def folder() -> str:
        return rng.choice((str(store), f"{store}/"))

    forms = [
        [], ["--json", "--all-columns"], ["--sort=psnr"], ["psnr>5", "--columns=seed,note"], ["--ids"],
        ["--all-columns"],
    ]  # fmt: skip
    yield ["runs", f"--store={folder()}", *rng.choice(forms), "--limit=0"]
    yield ["show", *run(target), *rng.choice(([], ["--json"], ["--config"]))]
    yield ["diff", str(store / target), str(store / other)]
    yield ["report", folder(), "--out=report", *rng.choice(([], [], ["--no-images"], ["--filter=state=finished"]))]
    forms = [
        [], ["--format=csv"], ["--format=latex"], ["--stability"], ["--units"], ["--shots-and-noise"], ["--smallest"],
        ["--paper=rgb"], ["--rows=scene_name,field", "--baseline=field=classical"],
    ]  # fmt: skip
    yield ["tables", folder(), *rng.choice(forms)]
    kind = rng.choice(("svg", "png", "pdf"))
    yield ["figures", folder(), *rng.choice(([], figures)), "--out=figures", f"--formats={kind}"]
    changing = [
        ["pack", folder(), "packed"],
        ["export", str(store / target), str(store / other), f"--to={rng.choice(('csv', 'csv', 'tensorboard'))}"],
        ["tag", *run(target), "seen"],
        ["note", *run(target), "looked at"],
        ["resume", *run(interrupted)],
    ]
    rng.shuffle(changing)
    yield from changing
    yield ["rm", "-y", str(store / target), str(store / third)]
    yield ["runs", f"--store={store}"]


def lighten(rng: random.Random) -> list[str]:
    """Leaves out most figures and tables of the report, and the waiting for other machines and for the disk.

    Returns the names of the figures that are left.
    """
    from qnerf.analysis.figures import FIGURES  # type: ignore[import-not-found]
    from qnerf.analysis.report import parts  # type: ignore[import-not-found]

    names = [rng.choice([name for name, entry in FIGURES.items() if not entry.benchmark])]
    for name in FIGURES.keys() - set(names):
        del FIGURES[name]
    parts.PAPER_FIGURES = tuple(name for name in parts.PAPER_FIGURES if name in names)
    parts.COLOURS = tuple(name for name in parts.COLOURS if name in names)
    parts.PAPER_TABLES = dict(rng.sample(sorted(parts.PAPER_TABLES.items()), 1))
    attempt, chosen = parts.attempt, rng.randrange(4)
    parts.attempt = lambda title, *rest: attempt(title, *rest) if len(title) % 4 == chosen else parts.ShownTable(title)
    owner.acquire.__defaults__ = (0.3,)
    records.RunStore.__init__.__kwdefaults__["watch"] = 0.3  # type: ignore[index]
    annotations.PATIENCE = 0.5
    os.fsync = lambda handle: None  # type: ignore[assignment]
    return names


# One case, in its own process


def attend(case: Case, base: Path, folder: Path, tell: Callable[[dict[str, Any]], None], wanted: Wanted) -> None:
    """Makes the store of a case and runs the commands; reports what it does and what went wrong."""
    os.environ["QNERF_CACHE"] = str(folder / "cache")
    work = folder / "work"
    work.mkdir()
    os.chdir(work)
    rng = random.Random(case.seed)
    figures = lighten(rng)
    shutil.copytree(base / "store", folder / "store", symlinks=True)
    if rng.random() < 0.5:  # with an index that is up to date
        locations.SETTLED = -1.0
        index.load(folder / "store")
    store = Store(folder / "store", base / "outside")
    what = []
    for name, number in case.mutations:
        try:
            what.append(MUTATIONS[name](store, random.Random(number)))
        except Skipped:
            what.append(f"{name}: nothing to change")
        except (OSError, ValueError) as error:  # a mutation met what an earlier one had left
            what.append(f"{name}: {type(error).__name__}")
    hard_linked = any(name == "hard_link" for name, _ in case.mutations)
    linked = hard_linked or any(path.is_symlink() for path in store.root.iterdir())
    tell({"changes": what, "linked": linked})
    out, err = (os.open(folder / name, os.O_RDWR | os.O_CREAT | os.O_TRUNC) for name in ("out", "err"))
    faulthandler.register(signal.SIGUSR1, file=os.fdopen(os.dup(err), "w"), all_threads=False)
    os.dup2(os.open(os.devnull, os.O_RDONLY), 0)
    os.dup2(out, 1)
    os.dup2(err, 2)
    sys.stdout = os.fdopen(1, "w", encoding="utf-8")
    sys.stderr = os.fdopen(2, "w", encoding="utf-8", errors="backslashreplace", buffering=1)
    size = int(Path("/proc/self/statm").read_text().split()[0]) * os.sysconf("SC_PAGE_SIZE")
    resource.setrlimit(resource.RLIMIT_AS, (size + MEMORY, size + MEMORY))
    for arguments in commands(case.seed, store.root, store.targets, figures):
        if not wanted(case, arguments[0]):
            continue
        for handle in (out, err):
            os.ftruncate(handle, 0)
            os.lseek(handle, 0, os.SEEK_SET)
        tell({"begin": line(arguments)})
        begin = time.process_time()
        for failure in problems(arguments, out, err):
            # A hard link is a file of the store like any other: its content is read and shown.
            if failure.kind != "secret" or not hard_linked:
                tell({"failure": dataclasses.asdict(failure)})
        tell({"end": arguments[0], "seconds": time.process_time() - begin})


def line(arguments: Sequence[str]) -> str:
    """The command, short and printable."""
    return " ".join(ascii(word)[1:-1][-80:] for word in arguments)


def problems(arguments: list[str], out: int, err: int) -> Iterator[Failure]:
    """Runs one command and yields what is wrong with how it ended and what it printed."""
    shown = line(arguments)
    try:
        code = console(*arguments)
        sys.stdout.flush()
        if code not in EXIT_CODES:
            yield Failure(shown, "exit code", "", repr(code)[:200])
    except BaseException as error:
        yield Failure(shown, "exception", place(error), f"{type(error).__name__}: {str(error)[:300]}")
    with contextlib.suppress(OSError, ValueError):
        sys.stdout.flush()
    sys.stderr.flush()
    for name, handle in (("stdout", out), ("stderr", err)):
        text = os.pread(handle, 2**22, 0).decode(errors="replace")
        if "Traceback (most recent" in text:
            yield Failure(shown, "traceback", text.strip().rpartition("\n")[2][:60], text[-400:])
        if (control := CONTROLS.search(text)) is not None:
            around = text[max(control.start() - 60, 0) : control.end() + 20]
            yield Failure(shown, "control character", f"{name} of {arguments[0]}", ascii(around))
        if SECRET in text:
            at = text.index(SECRET)
            yield Failure(shown, "secret", f"{name} of {arguments[0]}", ascii(text[max(at - 100, 0) : at + 30]))


def place(error: BaseException) -> str:
    """Type of an exception, and the last lines of our own code that it came through."""
    frames = traceback.extract_tb(error.__traceback__)
    ours = [frame for frame in frames if frame.filename.startswith(OURS)]
    last = frames[-1]
    named = [f"{'/'.join(Path(frame.filename).parts[-2:])}:{frame.lineno} {frame.name}" for frame in ours[-2:]]
    there = "" if ours and last is ours[-1] else f" > {Path(last.filename).name} {last.name}"
    return f"{type(error).__name__} at {' > '.join(named)}{there}"


# All cases


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
            if f"<{MARK}".encode() in data:
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
