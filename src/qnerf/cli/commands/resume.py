"""`qnerf resume RUN [threads=2 device=cpu run.progress=false scene.path=DIR]`."""

import argparse

from qnerf.cli.commands import add_overrides, add_run
from qnerf.cli.ends import stoppable, stopped_code
from qnerf.cli.stored import run_stored, stored
from qnerf.cli.text import console
from qnerf.records import find, owner, state
from qnerf.records.printable import printable


def arguments(parser: argparse.ArgumentParser) -> None:
    parser.description = (
        "Continues an interrupted or failed run from its last checkpoint, with the configuration that it was started "
        "with. Does nothing if the run is finished or running."
    )
    add_run(parser)
    add_overrides(parser)


@stoppable()
def main(options: argparse.Namespace) -> int:
    run = find(options.run, options.store).resolve()
    now = state(run)
    if now in ("finished", "running"):
        reason = "finished already" if now == "finished" else f"being written by {owner.describe(run)}"
        print(printable(f"{run}: {reason}"))
        return 0
    configuration = stored(run, options.overrides)

    from qnerf.cli.display import print_outcome

    outcome = run_stored(run, configuration, run.name)
    print_outcome(console(), outcome)
    return stopped_code() if outcome.state == "interrupted" else 0
