"""Validation views: chosen from what trains, and no test pixel reaches a run that holds them out."""

import copy
from dataclasses import replace

import pytest
import torch

from qnerf.building.configuration import Configuration
from qnerf.building.scene import prepare
from qnerf.experiment import run
from qnerf.records import read_metrics
from qnerf.records.read import read_evaluation
from qnerf.scenes.base import hold_out, split_views
from tests.helpers.configs import MOMENT, TINY, composed


@pytest.mark.parametrize("views", [4, 7, 50, 226])
@pytest.mark.parametrize("share", [0.01, 0.1, 0.5])
def test_validation_views_come_from_the_training_views_alone(views, share):
    train, test = split_views(views)
    kept, validation = hold_out(train, share)
    assert sorted([*kept, *validation]) == train
    assert validation
    assert not set(validation) & set(test)


def test_nothing_left_to_train_on_is_one_line():
    with pytest.raises(ValueError, match=r"^scene.validation=0.1: leaves nothing to train on, of 1 training views$"):
        hold_out([3], 0.1)


def poisoned(source):
    """The scene with other pixels, NaN where that is possible, in its test views; or the signal, in its test points."""
    if source.name != "poster":
        found = copy.copy(source)
        if source.name == "astronaut":
            found.truth = source.truth.clone()
            found.truth.flatten(0, 1)[source.unseen] = torch.nan
        else:
            found.unseen = torch.full_like(source.unseen, torch.nan)
        return found
    images, depth = source.images.clone(), source.depth.clone()
    images[source.eval], depth[source.eval] = 255 - images[source.eval], torch.nan
    return replace(source, images=images, depth=depth)


FIELD = ("field=classical", *TINY, *MOMENT, "scene.views=20", "stop.every=1", "stop.share=0.1", "needs=auto")
SIGNAL = ("head=mlp", "train.steps=3", "device=cpu")


@pytest.mark.parametrize(
    "overrides",
    [FIELD, ("scene=photograph", "scene.held_out=0.3", "scene.size=12", *SIGNAL), ("scene=distance", *SIGNAL)],
    ids=["field", "photograph", "distance"],
)
def test_no_test_pixel_reaches_a_run_that_holds_out_validation_views(overrides, tmp_path):
    """Training, `stop`, `auto` and every number of the evaluations, on the way and at the end."""
    found = []
    for name in ("clean", "poisoned"):
        more = ("scene.validation=0.2", "train.eval_every=1", f"store={tmp_path / name}")
        config = Configuration.of(composed(*overrides, *more))
        clean = prepare(Configuration.of(composed(*overrides))).source
        prepared = prepare(config, poisoned(clean) if name == "poisoned" else clean)
        outcome = run(prepared)
        logged = read_metrics(outcome.path).query("not key.str.startswith('time/')")
        found.append((prepared.decisions, logged.drop(columns="time_s"), read_evaluation(outcome.path)))
    (decided, metrics, held_out), (same, again, once_more) = found
    assert str(decided) == str(same)
    assert metrics[metrics["key"].str.startswith("eval/")]["value"].notna().all()
    assert metrics.equals(again)
    assert held_out.equals(once_more)
