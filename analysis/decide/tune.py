"""The same search for every candidate, on validation views and on seeds that judge nothing."""

import json
import uuid
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from qnerf.building.configuration import Configuration
from qnerf.building.model import parameter_counts
from qnerf.building.scene import prepare
from qnerf.cli import compose
from qnerf.cli.compose import configuration
from qnerf.config.settings import HEAD_GROUPS
from qnerf.metrics import metric_of
from qnerf.search.objectives import TUNING

from .records import title
from .study import Question, Record, found, started, trained

SHARE = 0.1  # of the training views, held out for validation
SHARED = ("scene", "seed", "store", "train.steps", "run", "hydra")
"""What all candidates of a study have alike, which no search may choose."""
WIDTHS = (2, 4, 8)  # of heads that are built to count their parameters
AGAIN = 3  # trials that are trained again with new seeds before one is chosen


def asked_spaces(question: Question) -> dict[str, str]:
    """Option -> its values, of `--space`; ValueError where a search cannot have them, or there is none."""
    if question.tune < 0:
        raise ValueError(f"--tune {question.tune}: expected a number of trials, 1 or more")
    asked = dict(text.partition("=")[::2] for text in question.space)
    if asked and not question.tune:
        raise ValueError(f"--space {question.space[0]}: is of a search; give --tune N, too")
    if len(asked) < len(question.space):
        raise ValueError(f"--space: expected each option once, got {' '.join(question.space)}")
    for text in question.space:
        if not compose.parse(text).is_sweep_override():
            raise ValueError(f"--space {text}: expected several values; one value stands in a candidate or in --all")
        if text.startswith(tuple(f"{name}{end}" for name in SHARED for end in "=.")):
            raise ValueError(f"--space {text}: is the same for all candidates; give it one value in --all")
    return asked


def spaces(record: Record, scene: str) -> dict[str, dict[str, str]]:
    """Candidate -> option -> its values: of the heads in which the candidates differ, what conf/head says beside them.

    An option that a candidate sets itself stays as it is, and depth is searched with the width that keeps the number of
    parameters. `--space` replaces values, and adds options that act.

    The record keeps them from before its first run.

    Raises:
        ValueError: nothing is left to search for a candidate, or `--space` names an option of none.
    """
    asked_for = replace(record, tuned={})  # also where a part of the study was searched before
    trees = {name: configuration(asked_for.words(scene, name)) for name in record.question.candidates}
    groups = [part for part in HEAD_GROUPS if len({json.dumps(tree.get(part)) for tree in trees.values()}) > 1]
    asked = asked_spaces(record.question)
    made = {}
    for name, tree in trees.items():
        typed = {word.partition("=")[0] for word in f"{scene} {record.question.common} {name}".split()}
        own = {
            f"train.rates.{part}" if key == "rate" else f"{part}.{key}": values
            for part in groups
            for key, values in tree[part]["space"].items()
        }
        for depth in [key for key in own if key.endswith(".layers")]:
            part, head, _ = depth.split(".")
            if "width" in tree[part][head]:  # one option of both, so that neither is searched where one is typed
                values = own.pop(depth)
                both = {f"{place}.{key}" for place in (f"{part}.{head}", head) for key in ("layers", "width")}
                if not both & {*typed, *asked}:
                    own[f"{part}.{head}"] = balanced(asked_for.words(scene, name), part, head, values.split(","))
        acting = {option.name for option in Configuration.of(tree).options}
        own |= {option: values for option, values in asked.items() if option in {*own, *acting}}
        made[name] = {key: own[key] for key in own if not {key, key.partition(".")[2]} & typed}
        if not made[name]:
            raise ValueError(f"{title(scene, name)}: --tune has nothing to search; give --space OPTION=VALUES")
    known = sorted({option for own in made.values() for option in own})
    if unknown := [option for option in asked if option not in known]:
        raise ValueError(f"--space {unknown[0]}: searched in no candidate; known: {', '.join(known)}")
    return made


def balanced(words: Sequence[str], part: str, head: str, depths: Sequence[str]) -> str:
    """Each depth of a head with the width that keeps its number of parameters, which is a polynomial of the width."""
    first = prepare(configuration(words))

    def count(**changed: object) -> int:
        own = prepare(
            configuration([*words, *(f"{part}.{head}.{key}={value}" for key, value in changed.items())]), first.source
        )
        own.task.build(own.settings)
        return parameter_counts(own.task.model)[f"params.{part}"]

    wanted, widths = count(), np.arange(1, 1025)
    pairs = []
    for layers in depths:
        counts = np.polyval(np.polyfit(WIDTHS, [count(layers=layers, width=width) for width in WIDTHS], 2), widths)
        pairs.append(f"{{layers:{layers},width:{widths[np.abs(counts - wanted).argmin()]}}}")
    return ",".join(pairs)


def tune(record: Record, scene: str, store: Path, foresee: Callable[[float], object]) -> None:
    """Searches each candidate of the scene that was not searched yet; the record keeps what was chosen and its cost."""
    question = record.question
    for name in question.candidates:
        if title(scene, name) in record.tuned:
            continue
        space = record.spaces[title(scene, name)]
        overrides = record.words(scene, name)
        unseen = prepare(configuration(overrides)).task.tests_unseen
        overrides += [f"scene.validation={SHARE}"] * unseen
        first = trained(overrides, TUNING[:1], store, foresee)  # its own options come first
        own, run = float(first[question.metric].iloc[0]), str(first.index[0])
        state = "finished" if np.isfinite(own) else "diverged"
        tried: list[dict[str, Any]] = [{"state": state, "values": [own], "overrides": []}]
        for count in (question.tune - 1, question.tune):  # the search may count its own options as one of its trials
            if count and len(tried) < question.tune:
                others = searched(record, count, [*overrides, f"seed={TUNING[0]}"], space, store, foresee)
                tried[1:] = [trial for trial in others if run not in trial["runs"]][: question.tune - 1]
        if any(trial["state"] == "unfinished" for trial in tried):
            raise ValueError(f"{title(scene, name)}: a trial of the search was stopped; the same command goes on")
        finished = [trial for trial in tried if trial["state"] == "finished"]
        if not finished:
            raise ValueError(f"{title(scene, name)}: no trial of the search finished")
        sign = metric_of(question.metric).sign
        finished.sort(key=lambda trial: -sign * trial["values"][0])
        again = {}
        for trial in finished[:AGAIN]:
            runs = trained([*overrides, *trial["overrides"]], TUNING[1:], store, foresee)
            again[tuple(trial["overrides"])] = float(runs[question.metric].mean(skipna=False))
        seeds = [(trial["overrides"], TUNING[:1]) for trial in tried] + [(point, TUNING[1:]) for point in again]
        seconds = sum(found([*overrides, *point], own, store)["train_s"].sum() for point, own in seeds)
        chosen = list(max(again, key=lambda point: sign * again[point] if np.isfinite(again[point]) else -np.inf))
        record.tuned[title(scene, name)] = {
            "trials": len(tried),
            "scores": [[trial["overrides"], number(*trial["values"]), trial["state"]] for trial in tried],
            "again": [[list(point), number(score)] for point, score in again.items()],
            "chosen": chosen,
            "seconds": float(seconds),
            "validation": SHARE if unseen else "other seeds: nothing was held out",
            "expected": expected([trial["values"][0] for trial in finished], sign),
        }
        record.save(store)
        told = ", ".join(chosen) or "its own options"
        minutes = record.tuned[title(scene, name)]["seconds"] / 60
        print(f"{title(scene, name)}: {len(tried)} trials, {minutes:.1f} minutes of training, chose {told}", flush=True)


def searched(
    record: Record,
    count: int,
    overrides: Sequence[str],
    space: dict[str, str],
    store: Path,
    foresee: Callable[[float], object],
) -> list[dict[str, Any]]:
    """`count` trials or more, by the search of `qnerf run`; the store is its memory."""
    from qnerf.cli.search import TRIALS  # needs Optuna, which only a search may ask for

    question = record.question
    folder = store / ".sweeps" / f"tune-{uuid.uuid4().hex[:12]}"
    started(
        [
            "hydra/sweeper=qnerf_optuna", f"hydra.sweeper.n_trials={count}", "hydra.sweeper.sampler=random",
            "hydra.sweeper.prune.percentile=0", f"hydra.sweeper.objectives=[{question.metric}]",
            f"hydra.sweep.dir={folder}", *overrides, f"store={store}",
            *(f"{option}={values}" for option, values in space.items()),
        ],
        foresee,
    )  # fmt: skip
    trials: list[dict[str, Any]] = json.loads((folder / TRIALS).read_text())
    return trials


def number(value: float | None = None) -> float | None:
    """None for no number, as JSON has it."""
    return value if value is not None and np.isfinite(value) else None


def expected(values: Sequence[float], sign: int) -> list[float]:
    """The expected best of 1, 2, ... trials drawn from these (Dodge et al., arXiv:1909.03004).

    >>> expected([20.0, 22.0], 1)
    [21.0, 21.5]
    """
    ordered, number = np.sort(sign * np.asarray(values, dtype=float)), len(values)
    share = np.arange(number + 1) / number
    return [float(sign * ordered @ np.diff(share**count)) for count in range(1, number + 1)]
