"""One mutated store of `tests.faults.fuzz_stores`: the template, the mutations of a copy of it, the commands on it."""

import contextlib
import dataclasses
import faulthandler
import hashlib
import json
import os
import random
import re
import resource
import shutil
import signal
import sys
import time
import traceback
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from qnerf import experiment, records
from qnerf.cli import main
from qnerf.probes import load, probe
from qnerf.probes.shots_and_noise import evaluate_hardware, grid
from qnerf.records import annotations, index, owner
from qnerf.records.index import locations
from tests.faults.mutations import MUTATIONS, Skipped, Store
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
    size = int(Path("/proc/self/statm").read_text().split()[0]) * os.sysconf("SC_PAGE_SIZE")
    resource.setrlimit(resource.RLIMIT_AS, (size + MEMORY, size + MEMORY))
    what = []
    for name, number in case.mutations:
        try:
            what.append(MUTATIONS[name](store, random.Random(number)))
        except Skipped:
            what.append(f"{name}: nothing to change")
        except Exception as error:  # a mutation met what an earlier one had left
            if len(case.mutations) == 1:
                raise
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
