"""`qnerf note RUN [TEXT]`."""

import argparse
import sys

from qnerf.cli.commands import add_run
from qnerf.records import annotations, find
from qnerf.records.printable import printable


def arguments(parser: argparse.ArgumentParser) -> None:
    parser.description = "Prints the note of a run, or replaces it by TEXT; an empty TEXT removes the note."
    add_run(parser)
    parser.add_argument("text", nargs="*", metavar="TEXT", help="the new note; - reads it from standard input")


def main(options: argparse.Namespace) -> None:
    run = find(options.run, options.store)
    if options.text:
        text = sys.stdin.read(annotations.NOTE_LENGTH + 2) if options.text == ["-"] else " ".join(options.text)
        annotations.write_note(run, text.strip())
    elif note := annotations.read(run).note:
        print(printable(note, annotations.NOTE_LENGTH, lines=True))
