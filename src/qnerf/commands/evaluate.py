"""`qnerf evaluate RUN shots=100,1000 noise=depolarizing p=0.001,0.01 views=0 seed=0`."""

import argparse
from typing import Any

from qnerf.commands import add_run
from qnerf.records import find

DEFAULTS = {"shots": "", "noise": "depolarizing", "p": "", "views": "0", "seed": "0"}


def arguments(parser: argparse.ArgumentParser) -> None:
    parser.description = "Renders a finished run's held-out views as hardware would: finite shots, noisy gates."
    add_run(parser)
    parser.add_argument(
        "options",
        nargs="*",
        metavar="KEY=VALUE",
        help="shots=100,1000 | noise=depolarizing p=0.001,0.01 | views=0 (0: all) | seed=0",
    )


def main(options: argparse.Namespace) -> None:
    run = find(options.run, options.store)
    from qnerf.evaluate_hardware import FILE, evaluate_hardware, grid

    values = dict(DEFAULTS)
    for option in options.options:
        key, _, value = option.partition("=")
        if key not in values:
            raise ValueError(f"qnerf evaluate: unknown option {key!r}; known: {', '.join(values)}")
        values[key] = value
    shots, p = _numbers(int, "shots", values["shots"]), _numbers(float, "p", values["p"])
    (views,), (seed,) = _numbers(int, "views", values["views"]), _numbers(int, "seed", values["seed"])
    evaluate_hardware(run, grid(shots, values["noise"], p, seed), views=views, tell=print)
    print(f"rows in {run / FILE}")


def _numbers(kind: type, name: str, text: str) -> list[Any]:
    try:
        return [kind(part) for part in text.split(",") if part]
    except ValueError:
        raise ValueError(f"{name} expects numbers with commas between them, got {text!r}") from None
