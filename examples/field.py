"""A field by the Python API, from the scene to a verdict: is a circuit as colour head better than an MLP?

    python examples/field.py

Two fields are trained with a few seeds each on the built-in scene. A run that the store has is not trained again, so
the second call takes a second. The steps are few, to take minutes: a verdict at 1,500 steps may be another one.
"""

import argparse
from pathlib import Path

from qnerf.analysis import load
from qnerf.analysis.tables import ablation
from qnerf.analysis.verdict import verdict

import qnerf

FIELDS = {
    "classical": ["color.directions=raw", "color.mlp.init=he"],  # the view directions and the start that qcolor has
    "qcolor": [],
}


def main(steps: int, seeds: int, store: Path, *more: str) -> None:
    common = [f"train.steps={steps}", f"store={store}", "run.preview_seconds=0", *more]
    for field, own in FIELDS.items():
        qnerf.sweep(f"field={field}", *own, *common, f"seed={','.join(map(str, range(seeds)))}")

    # One row a run: results, parameters, times and every option.
    runs = load.runs(store, f"train.steps={steps}")
    psnr = {field: runs.loc[runs["field"] == field, "psnr"] for field in FIELDS}
    found = verdict(psnr["classical"], psnr["qcolor"], within=0.5)
    print(f"qcolor - classical: {found.difference:+.2f} ± {found.reach:.2f} dB, {found.text()}")
    print(ablation(runs, ["scene_name", "field"], baseline="field=classical").markdown())

    # The model of a run, and a picture from one of its views.
    run = qnerf.load(runs["run_id"].iloc[0], store=store)
    counts = {name: sum(one.numel() for one in part) for name, part in run.model.parts.items()}
    print(run.id, counts)
    run.render(0).save(store / "view.png")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--steps", type=int, default=300)
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--store", type=Path, default=Path("runs-of-the-example"))
    parser.add_argument("overrides", nargs="*", help="further options, as of `qnerf run`")
    options = parser.parse_args()
    main(options.steps, options.seeds, options.store, *options.overrides)
