"""`qnerf rm RUN...`: deletes runs, after asking."""

import argparse
import sys
from pathlib import Path

from qnerf.cli.commands import add_many_runs
from qnerf.cli.text import STATE_STYLES, console, styled
from qnerf.records import find, state
from qnerf.records.deletion import delete_leftovers, delete_run, require_run
from qnerf.records.find import is_path
from qnerf.records.location import existing_store


def arguments(parser: argparse.ArgumentParser) -> None:
    parser.description = (
        "Deletes runs for good, after asking. A run that is being written is refused, and so is a link. "
        "Exit code 1: nothing was deleted."
    )
    add_many_runs(parser)
    parser.add_argument("--yes", "-y", action="store_true", help="delete without asking; expects whole ids or folders")


def main(options: argparse.Namespace) -> int:
    paths = list(dict.fromkeys(_checked(name, options.store, options.yes) for name in options.runs))
    out = console()
    for path in paths:
        now = state(path)
        out.print(styled(path, limit=200), styled(now, STATE_STYLES.get(now, "")), soft_wrap=True)
    if not options.yes and not _agreed(len(paths)):
        out.print("nothing deleted")
        return 1
    for path in paths:
        delete_run(path)
        out.print("deleted", styled(path.name), soft_wrap=True)
    for store in {path.parent for path in paths}:
        delete_leftovers(store)
    return 0


def _checked(name: str, store: str, whole: bool) -> Path:
    """The absolute path of the run. whole: as in `find`. ValueError for a link, and for a run that is being written."""
    path = Path(name) if is_path(name) else existing_store(store) / name
    if name and path.is_symlink():
        raise ValueError(f"{name}: is a link; `rm` without qnerf deletes it; nothing deleted")
    run = find(name, store, whole=whole).absolute()
    try:
        require_run(run)
        if state(run) == "running":
            raise ValueError(f"{run}: running; stop it first")
    except ValueError as error:
        raise ValueError(f"{error}; nothing deleted") from error
    return run


def _agreed(count: int) -> bool:
    if not sys.stdin.isatty():
        raise ValueError("cannot ask, standard input is not a terminal: --yes deletes without asking")
    question = f"delete {'this run' if count == 1 else f'these {count} runs'} for good? [y/N] "
    try:
        return input(question).strip().lower() in ("y", "yes")
    except EOFError:  # Ctrl-D
        print()
        return False
