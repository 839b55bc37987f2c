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


PHOTOGRAPH = ("scene=photograph", "scene.held_out=0.3", "scene.size=12", *SIGNAL)


def clean_and_poisoned(overrides, path):
    """Of a training on either: what `auto` decided, what was logged, the evaluation."""
    found = []
    for name in ("clean", "poisoned"):
        config = Configuration.of(composed(*overrides, "train.eval_every=1", f"store={path / name}"))
        plain = [text for text in overrides if not text.startswith("scene.validation")]
        source = prepare(Configuration.of(composed(*plain))).source
        prepared = prepare(config, poisoned(source) if name == "poisoned" else source)
        outcome = run(prepared)
        logged = read_metrics(outcome.path).query("not key.str.startswith('time/')")
        found.append((str(prepared.decisions), logged.drop(columns="time_s"), read_evaluation(outcome.path)))
    return found


@pytest.mark.parametrize(
    "overrides",
    [FIELD, PHOTOGRAPH, ("scene=distance", *SIGNAL)],
    ids=["field", "photograph", "distance"],
)
def test_no_test_pixel_reaches_a_run_that_holds_out_validation_views(overrides, tmp_path):
    """Training, `stop`, `auto` and every number of the evaluations, on the way and at the end."""
    clean, other = clean_and_poisoned((*overrides, "scene.validation=0.2"), tmp_path)
    (decided, metrics, held_out), (same, again, once_more) = clean, other
    assert decided == same
    assert metrics[metrics["key"].str.startswith("eval/")]["value"].notna().all()
    assert metrics.equals(again)
    assert held_out.equals(once_more)


@pytest.mark.parametrize("overrides", [FIELD, PHOTOGRAPH], ids=["field", "photograph"])
def test_a_run_without_validation_views_sees_the_poison(overrides, tmp_path):
    (_, _, held_out), (_, _, other) = clean_and_poisoned(overrides, tmp_path)
    assert not held_out.equals(other)
