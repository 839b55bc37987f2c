"""python -m tests.helpers.writing_runs STORE: runs that start, log, evaluate and finish, one after the other."""

import sys
from pathlib import Path

from qnerf.records import RunStore

RUNS, STEPS, VIEWS = 12, 20, 3

if __name__ == "__main__":
    store = RunStore(Path(sys.argv[1]), every=0.02)
    for number in range(RUNS):
        # the option is absent in the first run and a number in others: readers must join the types
        option = [None, 0.5, 2.0][number % 3]
        config = {"seed": number, "train": {"lr": 0.01}, "option": option}
        run = store.claim(f"r{number:02d}", config, columns={"field": "qcolor"}).run
        assert run is not None
        for step in range(STEPS):
            run.log(step, 0.1 * step, {"loss": 1 / (step + 1), "psnr": float(step)})
            run.flush()
            if step % 5 == 4:
                run.write_eval([{"image": f"{view}.png", "psnr": float(step)} for view in range(VIEWS)])
                run.write_summary({"psnr": float(step), "steps": step})
        run.finish({"psnr": float(STEPS), "steps": STEPS, "note": "n" * number})
