"""`qnerf tag RUN good,baseline --remove bad --note "worse at the edges"`."""

import argparse

from qnerf.cli.commands import add_run
from qnerf.records import annotations, find
from qnerf.records.printable import printable


def arguments(parser: argparse.ArgumentParser) -> None:
    parser.description = (
        "Adds or removes tags of a run, or writes its note, which `qnerf show` prints. Prints its tags, one per line."
    )
    add_run(parser)
    parser.add_argument("tags", nargs="*", metavar="TAG", help="tags to add; commas work too")
    parser.add_argument("--remove", action="append", default=[], metavar="TAG", help="a tag to remove")
    parser.add_argument("--note", metavar="TEXT", help="the new note of the run; an empty one removes it")


def main(options: argparse.Namespace) -> None:
    run = find(options.run, options.store)
    add, remove = _split(options.tags), _split(options.remove)
    if options.note is not None:
        annotations.write_note(run, options.note.strip())
    annotated = annotations.change_tags(run, add, remove) if add or remove else annotations.read(run)
    for tag in annotated.tags:
        print(printable(tag, annotations.TAG_LENGTH))


def _split(texts: list[str]) -> list[str]:
    return [tag for text in texts for tag in text.split(",") if tag]
