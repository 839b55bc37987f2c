"""`qnerf probe RUN shots=100,1000 noise=depolarizing p=0.001,0.01 views=0 seed=0`, or `qnerf probe RUN rays`."""

import argparse
from typing import Any

from qnerf.cli.commands import add_run
from qnerf.cli.upgrade_config import load_stored
from qnerf.config.bounds import NonNegativeInt, PositiveInt, Share, check
from qnerf.records import find

PROBES = ("spectrum", "encoding", "rays", "units", "cost")
DEFAULTS = {"shots": "", "noise": "depolarizing", "p": "", "views": "0", "seed": "0"}


def arguments(parser: argparse.ArgumentParser) -> None:
    parser.description = (
        "Measures the trained model of a finished run; the results go into the run's folder. With shots=... or "
        "noise=... it renders the held-out views as quantum hardware would: eval_hardware.parquet. PROBE is spectrum "
        "(Fourier power of the circuits), encoding (a slice of the encoders), rays (samples along a few rays), units "
        "(dead units and the spread of each layer's values, before and after training) or cost (gates, evaluations and "
        "hours of the circuits on quantum hardware): PROBE.parquet."
    )
    add_run(parser)
    parser.add_argument(
        "options",
        nargs="*",
        metavar="PROBE | KEY=VALUE",
        help=f"{' | '.join(PROBES)} | shots=100,1000 | noise=depolarizing p=0.001,0.01 | views=0 (0: all) | seed=0",
    )


def main(options: argparse.Namespace) -> None:
    run = find(options.run, options.store)
    names = [option for option in options.options if "=" not in option]
    repeated = [option for option in options.options if option.startswith("plugins=")]
    settings = [option for option in options.options if "=" in option and option not in repeated]
    _check(names, settings)
    conditions, views = _conditions(settings) if settings or not names else (None, 0)

    from qnerf.probes import probe
    from qnerf.probes.cost import RATE, SHOTS
    from qnerf.probes.shots_and_noise import FILE, evaluate_hardware
    from qnerf.records.read import read_probe

    trained = load_stored(run, repeated, unfinished=False)
    for name in names:
        path = probe(trained, name)
        print(path)
        if name == "cost":
            print(f"hours: {SHOTS:,} shots an evaluation, {RATE:,.0f} shots a second")
            print(read_probe(trained.folder, name).to_string(index=False, float_format="%.3g"))
    if conditions is not None:
        evaluate_hardware(trained, conditions, views=views, tell=print)
        print(f"rows in {trained.folder / FILE}")


def _check(names: list[str], settings: list[str]) -> None:
    for name in names:
        if name not in PROBES:
            raise ValueError(f"unknown probe {name!r}; known: {', '.join(PROBES)}")
    for key in (setting.partition("=")[0] for setting in settings):
        if key not in DEFAULTS:
            raise ValueError(f"unknown option {key!r}; known: {', '.join(DEFAULTS)}")


def _conditions(settings: list[str]) -> tuple[list[Any], int]:
    """The conditions to measure under, and the number of views."""
    from qnerf.probes.shots_and_noise import grid

    chosen = dict(option.split("=", 1) for option in settings)
    values = DEFAULTS | chosen
    shots, p = _numbers(int, "shots", values["shots"]), _numbers(float, "p", values["p"])
    views, seed = _one("views", values["views"]), _one("seed", values["seed"])
    if "noise" in chosen and not p:
        raise ValueError(f"noise={values['noise']} also expects probabilities, such as p=0.001,0.01")
    check("shots", shots, list[PositiveInt])
    check("p", p, list[Share])
    check("views", views, NonNegativeInt)
    check("seed", seed, NonNegativeInt)
    return grid(shots, values["noise"], p, seed), views


def _one(name: str, text: str) -> int:
    numbers = _numbers(int, name, text)
    if len(numbers) != 1 or numbers[0] < 0:
        raise ValueError(f"{name} expects one number of at least 0, got {text!r}")
    return int(numbers[0])


def _numbers(kind: type, name: str, text: str) -> list[Any]:
    try:
        return [kind(part) for part in text.split(",") if part]
    except ValueError:
        raise ValueError(f"{name} expects numbers with commas between them, got {text!r}") from None
