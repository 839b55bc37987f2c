"""Times one peer: `python -m benchmarks.peers.run NAME IN.npz OUT.npz REPEATS THREADS`."""

import importlib.metadata
import json
import os
import sys
import time


def main() -> None:
    name, source, target, repeats, threads = sys.argv[1:6]
    os.environ["OMP_NUM_THREADS"] = os.environ["MKL_NUM_THREADS"] = threads
    os.environ["XLA_FLAGS"] = f"--xla_cpu_multi_thread_eigen=true intra_op_parallelism_threads={threads}"
    import numpy as np

    from benchmarks.peers.circuits import PEERS

    build, package, samples = PEERS[name]
    try:
        import torch

        torch.set_num_threads(int(threads))
    except ImportError:
        pass
    data = np.load(source)
    x, w, g = data["x"], data["w"], data["g"]
    batch = len(x)
    if samples is not None:
        x, g = x[:samples], g[:samples]
    step = build(x.shape[1], len(w) // 2 - 1)
    begin = time.perf_counter()
    y, dx, dw = step(x, w, g)
    first = time.perf_counter() - begin
    times = []
    for _ in range(int(repeats)):
        begin = time.perf_counter()
        step(x, w, g)
        times.append((time.perf_counter() - begin) * batch / len(x))
    try:
        version = importlib.metadata.version(package.replace("tensorcircuit", "tensorcircuit-ng"))
    except importlib.metadata.PackageNotFoundError:
        version = ""
    about = {"times": times, "first": first, "version": version}
    np.savez(target, y=y, dx=dx, dw=dw, samples=len(x), about=json.dumps(about))


if __name__ == "__main__":
    main()
