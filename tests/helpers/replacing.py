"""python -m tests.helpers.replacing STORE: a run that replaces a part of its metrics as often as it can."""

import sys

from qnerf.records import RunStore

STEPS = 200

if __name__ == "__main__":
    from tests.helpers.stores import claimed

    run = claimed(RunStore(sys.argv[1], every=60))
    for step in range(STEPS):
        run.log(step, 0.0, {f"key {step} {i}": 1.0 for i in range(10)})
        run.flush()
    run.finish()
