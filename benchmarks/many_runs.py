"""A store of many runs, made by the real writer from real configurations: `python -m benchmarks.many_runs FOLDER`.

Nothing is trained: results and metrics are drawn from a seeded generator, everything else is what a run writes.
"""

import argparse
import itertools
import math
import time
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np
from hydra import compose, initialize_config_dir
from omegaconf import OmegaConf

import qnerf.cli.resolvers  # noqa: F401  the configuration needs them
from qnerf.config.folders import CONF
from qnerf.config.identity import run_id
from qnerf.model.labels import labels, slug
from qnerf.records import Run, RunStore
from qnerf.records.environment import capture
from qnerf.timing import STAGES

LOGS = 20  # how often a run logs `METRICS`
METRICS = ("train/loss", "train/psnr", "train/interlevel", "train/distortion", "train/lr", "train/rays_per_s")
FIELDS = ("classical", "qcolor", "qdensity", "qboth")
TABLES = ("C4", "C5")
CIRCUITS = ("1L1S", "1L2S", "2L1S")
ENCODERS = ("hash", "pe", "rff")
SCENES = ("fox", "poster", "lego", "garden")
RATES = (0.003, 0.01, 0.03)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder")
    parser.add_argument("--runs", type=int, default=10_000)
    parser.add_argument("--jobs", type=int, default=1, help="processes side by side")
    options = parser.parse_args()
    start = time.perf_counter()
    written = generate(options.folder, options.runs, options.jobs)
    print(f"{written:,} runs written in {time.perf_counter() - start:.1f} s")


def generate(folder: str | Path, runs: int, jobs: int = 1) -> int:
    """Adds runs until there are `runs`, and returns how many. One in 50 has failed, one in 50 was interrupted."""
    missing = runs - len(RunStore(folder).runs())
    if missing <= 0:
        return 0
    share = partial(_generate, str(folder), runs, jobs, compositions(str(folder)))
    with ProcessPoolExecutor(jobs, get_context("spawn")) as pool:
        return sum(pool.map(share, range(jobs)))


def compositions(store: str) -> list[dict[str, Any]]:
    """Resolved configurations of several fields, encoders, hash tables and circuits."""
    choices = itertools.product(FIELDS, ENCODERS, TABLES, CIRCUITS)
    with initialize_config_dir(str(CONF), version_base="1.3"):
        return [_composed(store, *choice) for choice in choices]


def _composed(store: str, field: str, encoder: str, table: str, circuit: str) -> dict[str, Any]:
    overrides = [f"field={field}", f"encoder={encoder}", f"hash={table}", f"qiren={circuit}", f"store={store}"]
    config: dict[str, Any] = OmegaConf.to_container(compose("config", overrides), resolve=True)  # type: ignore[assignment]
    return config


def configurations(bases: Sequence[Mapping[str, Any]]) -> Iterator[dict[str, Any]]:
    """An endless series of different configurations: every base with seeds, learning rates and scenes."""
    for seed in itertools.count():
        for rate, scene, base in itertools.product(RATES, SCENES, bases):
            train, path = {**base["train"], "lr": rate}, f"../shared/data/{scene}"
            yield {**base, "seed": seed, "train": train, "scene": {**base["scene"], "path": path}}


def write_some(folder: str | Path, runs: int, bases: Sequence[Mapping[str, Any]]) -> float:
    """Seconds for writing so many runs, one after the other."""
    start = time.perf_counter()
    written = _generate(str(folder), runs, 1, bases, 0)
    assert written == runs, "the folder holds runs already"
    return time.perf_counter() - start


def _generate(folder: str, runs: int, jobs: int, bases: Sequence[Mapping[str, Any]], job: int) -> int:
    """Writes every `jobs`-th run."""
    store = RunStore(folder)
    there = {path.name for path in store.runs()}
    environment = capture(seed=0)
    written = 0
    for number, config in enumerate(itertools.islice(configurations(bases), runs)):
        name = run_id(slug(config), config)
        if number % jobs != job or name in there:
            continue
        columns = labels(config) | _counts(config) | {"steps": 0}
        run = store.claim(name, config, [f"seed={config['seed']}"], columns=columns).run
        assert run is not None
        _write(run, number, config, environment, np.random.default_rng(number))
        written += 1
    return written


def _counts(config: Mapping[str, Any]) -> dict[str, int]:
    """Plausible parameter counts; no model is built."""
    heads = {"mlp": lambda head: 64 * 64 * head["mlp"]["layers"], "qiren": lambda head: 480 * head["qiren"]["layers"]}
    parts = {name: heads[config[name]["name"]](config[name]) for name in ("density", "color")}
    parts["encoder"] = config["hash"]["levels"] << config["hash"]["log2_table_size"]
    parts |= {"sampler": 655_746, "cameras": 0, "appearance": 0}
    return {f"params.{name}": count for name, count in {**parts, "total": sum(parts.values())}.items()}


def _write(
    run: Run, number: int, config: Mapping[str, Any], environment: Mapping[str, Any], random: np.random.Generator
) -> None:
    run.write_environment(environment)
    last = config["train"]["steps"]
    reached = last // 3 if number % 50 in (17, 31) else last
    final = random.normal(22.0, 2.0)
    for step in range(last // LOGS, reached + 1, last // LOGS):
        psnr = final - 10 * math.exp(-4 * step / last)
        run.log(step, step * 0.03, dict.fromkeys(METRICS, 10 ** (-psnr / 10)) | {"train/psnr": psnr})
    if number % 50 == 17:
        run.fail("loss is NaN at step 500")
    elif number % 50 == 31:
        run.interrupt()
    else:
        run.write_eval({"image": f"{view:03d}.png", "psnr": final + random.normal(0, 0.5)} for view in range(5))
        results = {"psnr": final, "ssim": random.uniform(0.6, 0.9), "train_s": random.uniform(50, 100), "steps": last}
        results |= {"step_ms": random.uniform(20, 60), "eval_views": 5, "eval_s": random.uniform(1, 2)}
        times = {f"time.{part}_ms": random.uniform(1, 20) for part in STAGES}
        run.finish(results | times | {"peak_memory_mb": 640.0, "lpips_reason": "weights not found"})


if __name__ == "__main__":
    main()
