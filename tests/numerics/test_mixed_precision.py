"""Mixed precision rounds the hidden layers of MLPs to bfloat16, and nothing else."""

from typing import Any

import pytest
import torch

from qnerf.building.configuration import Configuration
from qnerf.heads import HEADS
from qnerf.kernels import dispatch
from tests.helpers.trainer import trainer


@pytest.mark.parametrize("layers", [1, 2, 4])
def test_an_mlp_stays_within_the_roundings_of_bfloat16(layers: int) -> None:
    head, features = HEADS.build("mlp", 16, 4, layers=layers, width=64, init="he"), torch.randn(500, 16)
    with dispatch.plain():
        exact = head(features)
    head.mixed = True  # type: ignore[assignment]
    values = head(features)
    (gradient,) = torch.autograd.grad(values.square().sum(), head.net[0].weight)  # type: ignore[union-attr, index]
    assert values.dtype == gradient.dtype == torch.float32
    assert bool(gradient.isfinite().all())
    error = float((values - exact).detach().abs().max() / exact.detach().abs().max())
    assert error == 0 if layers == 1 else 0 < error < 2 * layers * torch.finfo(torch.bfloat16).eps


def test_only_mlps_compute_in_it(tiny: Any) -> None:
    full = tiny("field=qcolor", "train.rays=32")
    mixed = tiny("field=qcolor", "train.rays=32", "numerics.precision=mixed")
    with dispatch.report() as aside:
        one, other = trainer(full), trainer(mixed)
        assert one.take_step(measure=True)["train/loss"] != other.take_step(measure=True)["train/loss"]
    assert aside["hash grid + MLP"] == "mixed precision"
    assert "circuits" not in aside
    head, features = other.model.field.color_head, torch.randn(20, 8)
    reference = one.model.field.color_head
    reference.load_state_dict(head.state_dict())
    width = next(reference.parameters()).shape[1]
    features = torch.randn(20, width)
    assert torch.equal(head.eval()(features), reference.eval()(features))
    assert all(bool(p.isfinite().all()) for p in other.model.parameters())


def test_it_is_part_of_an_id_where_an_mlp_computes_in_it(tiny: Any) -> None:
    def acts(*options: str) -> bool:
        return "numerics.precision" in Configuration.of(tiny(*options, "numerics.precision=mixed")).decisive

    assert acts("field=classical")
    assert acts("field=qcolor")
    assert not acts("field=qboth")
    assert not acts("field=classical", "numerics.dtype=float64")
