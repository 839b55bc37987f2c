"""`qnerf resume RUN [threads=2 device=cpu run.progress=false scene.path=DIR]`."""

import argparse

from qnerf.cli.commands import add_run
from qnerf.cli.text import console
from qnerf.cli.upgrade_config import CHANGEABLE, check_identity, stored
from qnerf.records import find, owner, state
from qnerf.records.printable import printable


def arguments(parser: argparse.ArgumentParser) -> None:
    parser.description = (
        "Goes on with an interrupted or failed run from its last checkpoint, with the configuration that it was "
        "started with. A finished or running one is left alone."
    )
    add_run(parser)
    parser.add_argument(
        "overrides", nargs="*", metavar="KEY=VALUE", help=f"any of {', '.join(CHANGEABLE)}; plugins=[A,B] of the run"
    )


def main(options: argparse.Namespace) -> int:
    run = find(options.run, options.store).resolve()
    now = state(run)
    if now in ("finished", "running"):
        reason = "finished already" if now == "finished" else f"being written by {owner.describe(run)}"
        print(printable(f"{run}: {reason}"))
        return 0
    config, filled = stored(run, options.overrides)

    from qnerf import experiment
    from qnerf.cli.display import LiveDisplay, print_outcome
    from qnerf.training.trainer import Diverged

    check_identity(run, experiment.prepare(config)[2].fingerprint)
    display = LiveDisplay(console(), live=config["run"]["progress"])
    if filled:
        display.note(f"the run is older than some options, which have today's defaults: {', '.join(filled)}")
    try:
        outcome = experiment.run(config, (), display, name=run.name)
    except Diverged as error:
        raise ValueError(str(error)) from error
    print_outcome(display.console, outcome)
    return 130 if outcome.state == "interrupted" else 0
