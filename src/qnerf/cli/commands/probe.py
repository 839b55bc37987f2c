"""`qnerf probe RUN shots=100,1000 noise=depolarizing p=0.001,0.01 readout=0.02`, or `qnerf probe RUN units`."""

import argparse
import contextlib
import functools
from collections.abc import Mapping
from typing import Any

from qnerf.cli.commands import STORED, add_run
from qnerf.cli.stored import load_stored, split
from qnerf.config.bounds import NonNegativeInt, PositiveInt, Share, check
from qnerf.records import find

DIAGNOSTICS = ("expressibility", "entangling", "fisher", "kernel", "surrogate")
PROBES = ("spectrum", "units", "cost", *DIAGNOSTICS)
DEFAULTS: dict[str, Any] = {"shots": [], "noise": "depolarizing", "p": [], "seed": 0}
KINDS: dict[str, Any] = {
    "shots": list[PositiveInt],
    "noise": str,
    "p": list[Share],
    "views": NonNegativeInt,
    "seed": NonNegativeInt,
    "patterns": PositiveInt,
}


def arguments(parser: argparse.ArgumentParser) -> None:
    parser.description = (
        "Measures the trained model of a finished run; the results go into the run's folder. With shots=... or "
        "noise=... it renders the held-out views as hardware would: eval_hardware.parquet. Noise is exact where "
        "density matrices are quick, else the mean over patterns of Pauli errors. PROBE is spectrum (Fourier power of "
        "the circuits), units "
        "(dead units and the spread of each layer's values, before and after training), cost (gates, evaluations and "
        "hours of the circuits on quantum hardware), or a diagnostic of the circuits: expressibility, entangling, "
        "fisher (information, effective dimension), kernel (tangent) or surrogate (a classical one): PROBE.parquet."
    )
    add_run(parser)
    parser.add_argument(
        "options",
        nargs="*",
        metavar="PROBE | KEY=VALUE",
        help=f"{' | '.join(PROBES)} | shots=100,1000 | noise=depolarizing p=0.001,0.01 | "
        "two_qubit=0.01 | readout=0.02 | t1=1e-4 t2=8e-5 one_qubit_time=3e-8 two_qubit_time=3e-7 | patterns=100 | "
        f"views=0 (0: all) | seed=0; {STORED}",
    )


def main(options: argparse.Namespace) -> None:
    run = find(options.run, options.store)
    own, overrides = split(options.options)
    names = [option for option in own if "=" not in option]
    settings = dict(option.split("=", 1) for option in own if "=" in option)
    if unknown := [name for name in names if name not in PROBES]:
        raise ValueError(f"unknown probe {unknown[0]!r}; known: {', '.join(PROBES)}")
    conditions, counts = _conditions(settings) if settings or not names else (None, {})

    from qnerf.probes import probe
    from qnerf.probes.cost import RATE, SHOTS
    from qnerf.probes.shots_and_noise import FILE, evaluate_hardware
    from qnerf.records.read import read_probe

    trained = load_stored(run, overrides, unfinished=False)
    for name in names:
        path = probe(trained, name)
        print(path)
        if name == "cost":
            print(f"hours: {SHOTS:,} shots an evaluation, {RATE:,.0f} shots a second")
        if name == "cost" or name in DIAGNOSTICS:
            table = read_probe(trained.folder, name)
            shown = table[table["index"] == 0] if "index" in table else table  # of a spectrum its largest eigenvalue
            print(shown.to_string(index=False, float_format="%.3g"))
    if conditions is not None:
        evaluate_hardware(trained, conditions, **counts, tell=functools.partial(print, flush=True))
        print(f"rows in {trained.folder / FILE}")


def _conditions(settings: Mapping[str, str]) -> tuple[list[Any], dict[str, int]]:
    """The conditions to measure under, and the numbers of views and patterns."""
    from qnerf.probes.shots_and_noise import OTHERS, grid

    kinds = KINDS | dict.fromkeys(OTHERS, float)
    given: dict[str, Any] = {}
    for key, text in settings.items():
        if key not in kinds:
            raise ValueError(f"unknown option {key!r}; known: {', '.join(kinds)}")
        numbers = [_number(part) for part in text.split(",")]
        single = numbers[0] if len(numbers) == 1 else text
        given[key] = numbers if key in ("shots", "p") else single
        check(key, given[key], kinds[key])
    if "noise" in given and "p" not in given:
        raise ValueError(f"noise={given['noise']} also expects probabilities, such as p=0.001,0.01")
    counts: dict[str, int] = {key: given.pop(key) for key in ("views", "patterns") if key in given}
    chosen = {key: given.pop(key, default) for key, default in DEFAULTS.items()}
    return grid(**chosen, others=given), counts


def _number(text: str) -> int | float | str:
    for kind in (int, float):
        with contextlib.suppress(ValueError):
            return kind(text)
    return text
