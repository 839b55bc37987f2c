"""Runs for the tests of the store."""

import json

CONFIG = {
    "seed": 0,
    "train": {"lr": 1e-6, "steps": 10, "eval_views": None},
    "scene": {"name": "poster", "path": None, "label": "fox"},
    "odd": ["a", 1],
    "hydra": {"x": 1},
}


def claimed(store, name="a", **options):
    claim = store.claim(name, CONFIG, ["seed=0"], **options)
    assert claim.run is not None, claim.message
    return claim.run


def vanish(run, **left):
    """Leaves the run as a killed process would: nothing more is written and its owner is not alive.

    left: what its files say about their owner; default: that a process with its number started at another time.
    """
    run._stop()
    run._closed = True
    for path in [run.dir / "status.json", *run.dir.glob("owner/*.json")]:
        record = json.loads(path.read_text()) | (left or {"started": "1"})
        path.write_text(json.dumps(record))
