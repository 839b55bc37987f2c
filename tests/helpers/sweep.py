"""A small store of real runs, trained once a test session: two fields, two seeds, and runs that did not finish."""

import shutil

import qnerf
from qnerf.experiment import run
from tests.helpers.configs import MOMENT, TINY, composed
from tests.helpers.packed_stores import write_run
from tests.helpers.scenes import write_scene

FIELDS = ("classical", "qcolor")
SEEDS = (0, 1)


def sweep(folder):
    """The store below `folder`; it is there already if another test asked for it."""
    store = folder / "sweep"
    if store.exists():
        return store
    scene = ["scene=nerfstudio", f"scene.path={write_scene(folder / 'ring', width=12, height=9)}", f"store={store}"]
    small = [*TINY, *MOMENT, "train.steps=6", "train.eval_every=3", "qiren=1L2S", "qiren.qubits=3"]
    for field in FIELDS:
        for seed in SEEDS:
            run(composed(*scene, *small, f"field={field}", f"seed={seed}"))
    write_run(store, "qcolor", 7, scene="ring", state="failed")
    write_run(store, "qcolor", 8, scene="ring", state="interrupted")
    return store


def mixed(folder):
    """`sweep`, and photographs, a distance and tracked loops beside it in one store."""
    store = folder / "mixed"
    shutil.copytree(sweep(folder), store, symlinks=True)
    small = ["train.steps=4", "train.log_every=1", "train.eval_every=2", "train.points=64", "qiren.qubits=2"]
    for scene, size, head, seed in (
        ("photograph", "size=12", "mlp", 0),
        ("photograph", "size=12", "mlp", 1),
        ("photograph", "size=12", "qiren", 0),
        ("distance", "samples=100", "mlp", 0),
        ("distance", "samples=100", "qiren", 0),
    ):
        chosen = [f"scene={scene}", f"scene.{size}", f"head={head}", f"seed={seed}"]
        run(composed(*chosen, *small, "hash=C7", "device=cpu", f"store={store}"))
    for name, psnr in (("mine", 20.0), ("other", 25.0)):
        for seed in range(3):
            with qnerf.track({"scene": "digits", "seed": seed, "own": name}, name=name, store=store) as tracked:
                tracked.log(1, loss=0.5)
                tracked.finish(psnr=psnr + 0.1 * seed, accuracy=0.9)
    return store
