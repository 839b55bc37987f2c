"""Training steps by compiled loops against the same steps by plain PyTorch operations."""

import copy
import dataclasses

import pytest
import torch

from qnerf.kernels import plain
from qnerf.training import trainer as module
from tests.helpers.trainer import trainer

STEPS = 20  # of which the last ten are mostly steps in which the proposal networks do not learn
COMBINATIONS = [
    *(
        f"field={field} encoder={encoder}"
        for field in ("classical", "qcolor", "qdensity")
        for encoder in ("hash", "pe")
    ),
    "field=qboth shading=none density.activation=softplus",
    "field=classical shading=none render.background=random appearance=3 color.directions=sh",
    "field=classical contraction=box hash.features=3 render.background=white color.mlp.layers=1",
    "field=classical visibility.cameras=1 density.mlp.layers=3",
    "field=classical sampler=uniform sampler.samples=8 appearance=2",
    "field=classical contraction=box cameras=so3xr3 hash.features=3",
]


@pytest.mark.parametrize("dtype", ["float32", "float64"])
@pytest.mark.parametrize("overrides", COMBINATIONS)
def test_steps_of_compiled_loops_are_those_of_plain_operations(overrides, dtype, tiny, monkeypatch):
    """From the same state: losses to rounding, and gradients up to a ReLU that rounding flips in a single step."""
    gradients = []

    def keep(optimiser):
        parts = {group["name"]: [one.grad for one in group["params"]] for group in optimiser.param_groups}
        gradients.append(
            {
                name: torch.cat([one.flatten().clone() for one in part if one is not None])
                for name, part in parts.items()
                if any(one is not None for one in part)
            }
        )
        apply_gradients(optimiser)

    apply_gradients = module.apply_gradients
    monkeypatch.setattr(module, "apply_gradients", keep)
    config = tiny(*overrides.split(), "train.rays=40", "train.steps=100", f"numerics.dtype={dtype}")
    fast, slow = trainer(config), trainer(config)
    errors = {}
    close, closer = (3e-4, 1e-3) if dtype == "float32" else (1e-11, 1e-8)
    for step in range(STEPS):
        if step:
            slow.load(copy.deepcopy(fast.state()))
        loss = fast.take_step(measure=True)["train/loss"]
        with plain():
            expected = slow.take_step(measure=True)["train/loss"]
        assert loss == pytest.approx(expected, rel=close)
        ours, theirs = gradients[-2:]
        assert ours.keys() == theirs.keys()
        for part, gradient in theirs.items():
            error = float((ours[part] - gradient).norm() / gradient.norm().clamp(min=1e-12))
            errors.setdefault(part, []).append(error)
    assert {part for part, found in errors.items() if sorted(found)[STEPS // 2] > closer} == set(), errors


def transpose(taken):
    weight = taken.model.field.color_head.net[0].weight
    weight.data = weight.data.T.contiguous().T


def double_gradient(taken):
    taken.model.field.density_head.net[0].weight.register_hook(lambda gradient: 2 * gradient)


def freeze(taken):
    taken.model.field.density_head.net[0].bias.requires_grad_(False)


def shift_colors(taken):
    taken.model.field.color_head.register_forward_hook(lambda _module, _given, values: values + 1)


def square_loss(taken):
    terms = taken.loss_terms
    taken.loss_terms = lambda *given: {name: term.square() for name, term in terms(*given).items()}


def add_late_term(taken):
    """A loss that looks at the points with weight only, and starts at step 2."""
    terms = taken.loss_terms

    def with_late_term(rendering, *given):
        found = terms(rendering, *given)
        if taken.step >= 2:
            found["visible"] = rendering.weights[rendering.weights > 0.01].square().sum()
        return found

    taken.loss_terms = with_late_term


def edit_forward(taken):
    forward = type(taken.model).forward

    class Halved(type(taken.model)):
        def forward(self, rays, **options):
            rendering, sampled, behind = forward(self, rays, **options)
            return dataclasses.replace(rendering, color=rendering.color / 2), sampled, behind

    taken.model.__class__ = Halved


CHANGES = [transpose, double_gradient, freeze, shift_colors, square_loss, add_late_term, edit_forward]


@pytest.mark.parametrize("change", CHANGES, ids=lambda change: change.__name__)
def test_what_is_done_to_a_model_between_steps_acts(change, tiny):
    """In the gradients, too: the steps of compiled loops are those of plain operations, and not those of no change."""
    config = tiny("field=classical", "train.rays=40", "train.steps=100", "numerics.dtype=float64")
    fast, slow, unchanged = trainer(config), trainer(config), trainer(config)
    for step in range(5):
        if step == 1:
            change(fast), change(slow)
        loss = fast.take_step(measure=True)["train/loss"]
        unchanged.take_step(measure=False)
        with plain():
            assert loss == pytest.approx(slow.take_step(measure=True)["train/loss"], rel=1e-9)
    own, others = (torch.cat([one.flatten() for one in each.model.parameters()]) for each in (fast, unchanged))
    assert change is transpose or not torch.equal(own, others)
