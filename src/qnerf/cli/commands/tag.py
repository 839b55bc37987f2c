"""`qnerf tag RUN good,baseline --remove bad`."""

import argparse

from qnerf.cli.commands import add_run
from qnerf.records import annotations, find
from qnerf.records.printable import printable


def arguments(parser: argparse.ArgumentParser) -> None:
    parser.description = "Adds or removes tags of a run; without TAG, prints its tags, one per line."
    add_run(parser)
    parser.add_argument("tags", nargs="*", metavar="TAG", help="tags to add; commas work too")
    parser.add_argument("--remove", action="append", default=[], metavar="TAG", help="a tag to remove")


def main(options: argparse.Namespace) -> None:
    run = find(options.run, options.store)
    add, remove = _split(options.tags), _split(options.remove)
    annotated = annotations.change_tags(run, add, remove) if add or remove else annotations.read(run)
    for tag in annotated.tags:
        print(printable(tag, annotations.TAG_LENGTH))


def _split(texts: list[str]) -> list[str]:
    return [tag for text in texts for tag in text.split(",") if tag]
