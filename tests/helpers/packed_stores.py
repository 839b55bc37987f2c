"""Small stores of runs through the real writer, with the numbers that a test asks for."""

import re

import numpy as np

from qnerf.records import RunStore

HEADS = {
    "classical": ("2x64", "3x64"),
    "qcolor": ("2x64", "1L2S"),
    "qdensity": ("1L2S", "3x64"),
    "qboth": ("1L2S",) * 2,
}
IDLE = {"machine": "a", "time.threads": 2, "time.load": 0.5}
"""An idle machine, on which times can be compared."""

COUNTS = {"2x64": 1222, "3x64": 5763, "1L2S": 491}


def write_run(
    store,
    field="classical",
    seed=0,
    psnr=(20.0, 22.0),
    *,
    scene="poster",
    state="finished",
    config=None,
    columns=None,
    results=None,
    pictures=None,
):
    """One run whose views 0, 1, ... have these PSNR in dB; its summary has their mean. Returns its folder."""
    density, color = HEADS[field]
    settings = {"seed": seed, "scene": {"name": scene, "path": None}, "train": {"steps": 10}} | dict(config or {})
    names = {"field": field, "encoder": "hash", "hash": "C5", "scene": scene, "density": density, "color": color}
    counts = {"params.encoder": 393216, "params.density": COUNTS[density], "params.color": COUNTS[color]}
    counts["params.total"] = sum(counts.values())
    name = "-".join([scene, field, f"s{seed}", *(f"{key}{value}" for key, value in (columns or {}).items())])
    claim = RunStore(store).claim(
        re.sub("[.=]", "", name),
        settings,
        columns=names | {"train": "quick"} | counts | dict(columns or {}),
        types={"seed": "int", "train.steps": "int"},
    )
    with claim.run as run:
        run.write_eval([{"image": f"{view}.png", "psnr": value, "ssim": value / 40} for view, value in enumerate(psnr)])
        for picture, pixels in (pictures or {}).items():
            run.save_image(picture, pixels)
        mean = float(np.mean(psnr))
        measured = {"psnr": mean, "ssim": mean / 40, "step_ms": 10.0 + seed, "train_s": 5.0, **IDLE} | dict(
            results or {}
        )
        {
            "finished": lambda: run.finish(measured),
            "failed": lambda: run.fail("out of memory"),
            "interrupted": run.interrupt,
        }[state]()
    return claim.dir


def picture(*panels: np.ndarray, factor: int = 4) -> np.ndarray:
    """truth | render | error | depth as a run stores them: side by side, each pixel a square."""
    return np.concatenate(panels, axis=1).repeat(factor, 0).repeat(factor, 1)
