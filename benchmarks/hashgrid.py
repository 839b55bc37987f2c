"""The speed of the hash encoding, compiled and in plain PyTorch: `python -m benchmarks.hashgrid`.

Prints a table of medians and saves all numbers to benchmarks/results/hashgrid.parquet.
"""

import argparse
import time
from collections.abc import Callable
from pathlib import Path

import pandas as pd
import torch
from torch import Tensor

from qnerf.encoders import level_resolutions
from qnerf.kernels.hashgrid import hash_encode, hash_encode_reference

CASES = {  # points, levels, min resolution, max resolution, log2 of the table, features
    "proposal 128": (128 * 256, 5, 16, 128, 17, 2),
    "proposal 256": (128 * 96, 5, 16, 256, 17, 2),
    "C1": (128 * 48, 16, 16, 2048, 19, 2),
    "C4": (128 * 48, 12, 16, 2048, 17, 1),
    "C5": (128 * 48, 12, 16, 1024, 15, 1),
    "C7": (128 * 48, 8, 16, 1024, 13, 1),
}
PATHS = {"fast": hash_encode, "reference": hash_encode_reference}


def along_rays(points: int, rays: int = 128) -> Tensor:
    """Points (N, 3) along rays, in the order of a training step."""
    generator = torch.Generator().manual_seed(0)
    origins = 0.4 + 0.2 * torch.rand(rays, 1, 3, generator=generator)
    directions = torch.nn.functional.normalize(torch.randn(rays, 1, 3, generator=generator), dim=-1)
    return (origins + directions * torch.linspace(0, 0.4, points // rays)[:, None]).reshape(-1, 3).contiguous()


def milliseconds(function: Callable[[], object], repeats: int) -> list[float]:
    function()
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        function()
        times.append(1e3 * (time.perf_counter() - start))
    return times


def measure(name: str, threads: int, repeats: int) -> list[dict[str, object]]:
    torch.set_num_threads(threads)
    count, levels, low, high, log2_size, features = CASES[name]
    points = along_rays(count)
    cells = torch.tensor(level_resolutions(levels, low, high))
    table = torch.rand(levels, 2**log2_size, features, generator=torch.Generator().manual_seed(1))
    rows = []
    for path, encode in PATHS.items():
        leaf, moving = table.clone().requires_grad_(), points.clone().requires_grad_()
        to_table, to_points = encode(points, leaf, cells), encode(moving, table, cells)
        weight = torch.ones_like(to_table)
        parts = {
            "forward": lambda encode=encode: encode(points, table, cells),
            "table gradient": lambda out=to_table, leaf=leaf, w=weight: torch.autograd.grad(
                out, leaf, w, retain_graph=True
            ),
            "points gradient": lambda out=to_points, leaf=moving, w=weight: torch.autograd.grad(
                out, leaf, w, retain_graph=True
            ),
        }
        for part, function in parts.items():
            times = pd.Series(milliseconds(function, repeats))
            rows.append(
                {
                    "case": name,
                    "points": count,
                    "parameters": table.numel(),
                    "threads": threads,
                    "part": part,
                    "path": path,
                    "ms": times.median(),
                    "ms_low": times.quantile(0.25),
                    "ms_high": times.quantile(0.75),
                    "repeats": repeats,
                }
            )
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--threads", type=int, nargs="+", default=[1, 2])
    parser.add_argument("--repeats", type=int, default=9)
    options = parser.parse_args()
    frame = pd.DataFrame(
        [row for threads in options.threads for name in CASES for row in measure(name, threads, options.repeats)]
    )
    target = Path(__file__).parent / "results" / "hashgrid.parquet"
    target.parent.mkdir(exist_ok=True)
    frame.to_parquet(target, index=False)
    wide = frame.pivot_table(index=["threads", "case", "part"], columns="path", values="ms", sort=False)
    wide["times faster"] = wide["reference"] / wide["fast"]
    print(wide.round(2).to_string())
    print(f"milliseconds, medians of {options.repeats}; saved to {target}")


if __name__ == "__main__":
    main()
