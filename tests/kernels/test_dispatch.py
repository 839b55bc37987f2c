"""Which compiled loops serve a call, and what is said where one steps aside: kernels/dispatch.py."""

from typing import Annotated, Any

import pytest
import torch
from annotated_types import Interval
from torch import nn

from qnerf.encoders import HashEncoder
from qnerf.geometry.contraction import Box, CubeContraction
from qnerf.heads import MLPHead
from qnerf.kernels import dispatch, plain
from qnerf.kernels.dispatch import LOOPS, report, serves
from qnerf.model.field import Field
from qnerf.rendering.samplers import SAMPLERS
from tests.helpers.configs import composed
from tests.helpers.trainer import trainer

GRID = {"levels": 2, "max_resolution": 16, "log2_table_size": 6}


class Windowed(HashEncoder):
    """A class derived from the hash grid with an option of its own."""

    def __init__(self, in_dim: int, *, window: Annotated[float, Interval(ge=0)] = 0.0, **grid: Any) -> None:
        super().__init__(in_dim, **grid)


def field(encoder=None, head=None):
    encoder = encoder or HashEncoder(3, **GRID)
    head = head or MLPHead(encoder.out_dim, 4, width=8)
    activations = (torch.exp, torch.sigmoid)
    return Field(CubeContraction(), encoder, nn.Identity(), head, nn.Identity(), *activations, 1.0, 1, [0], 0)


def aside(one, points=None):
    """What steps aside where the field is evaluated; its values are those of the modules."""
    points = torch.rand(4, 3, 3) if points is None else points
    with report() as told:
        _, features, _ = one.geometry(points)
    if not points.requires_grad:
        expected = one.density_head(one.encoder(one.contraction(points).reshape(-1, 3)))[:, 1:]
        torch.testing.assert_close(features.reshape(-1, 3), expected)
    return told


def hooked(one):
    one.density_head.net[0].register_forward_hook(lambda *_: None)
    return one


def replaced(one, number, layer):
    one.density_head.net[number] = layer
    return one


def with_own_forward(one):
    one.encoder.forward = lambda points: HashEncoder.forward(one.encoder, points)
    return one


REASONS = {
    "Windowed extends HashEncoder": lambda: field(Windowed(3, **GRID)),
    "hooks on Linear": lambda: hooked(field()),
    "another forward of HashEncoder": lambda: with_own_forward(field()),
}


def test_hash_grid_with_mlp_says_why_it_steps_aside():
    assert aside(field()) == aside(field(head=MLPHead(2, 4, layers=3, width=8))) == {}
    for reason, build in REASONS.items():
        assert aside(build())["hash grid + MLP"] == reason
    but = "not linear layers with biases and ReLU between them"
    for number, layer in ((1, nn.Tanh()), (2, nn.Linear(8, 4, bias=False))):
        assert aside(replaced(field(), number, layer)) == dict.fromkeys(["hash grid + MLP", "MLP"], but)
    assert aside(field(), torch.rand(4, 3, 3).requires_grad_()) == {"hash grid + MLP": "the points need a gradient"}
    handle = nn.modules.module.register_module_forward_hook(lambda *_: None)
    assert aside(field()) == dict.fromkeys(["hash grid + MLP", "MLP"], "hooks on all modules")
    handle.remove()


def test_an_option_that_came_after_the_loop_makes_it_step_aside(monkeypatch):
    older = {path: options - {"dense"} for path, options in LOOPS["hash grid + MLP"].items()}
    monkeypatch.setitem(LOOPS, "hash grid + MLP", older)
    assert aside(field()) == {"hash grid + MLP": "option dense of HashEncoder"}


def test_known_classes_exist_and_have_the_options_of_the_table():
    for loop in LOOPS.values():
        for path, options in loop.items():
            module, name = path.rsplit(".", 1)
            kind = getattr(__import__(module, fromlist=[name]), name)
            assert dispatch._options(kind) == options, path


def test_loops_serve_the_dtypes_devices_and_modules_that_they_know():
    x = torch.zeros(2)
    told = {
        "float16": lambda: serves("hash grid", x.half()),
        "float64": lambda: serves("hash grid", x, x.double()),
        "device meta": lambda: serves("hash grid", x.to("meta")),
        "torch.func or forward-mode derivatives": lambda: torch.func.vmap(
            lambda one: one if serves("hash grid", one) else -one
        )(x),
        "other": lambda: serves("hash grid", x, but="other"),
    }
    assert serves("hash grid", x)
    assert serves("hash grid", x.double())
    for reason, call in told.items():
        with report() as aside:
            call()
        assert aside == {"hash grid": reason}
    with plain(), report() as aside:
        assert not serves("hash grid", x)
    assert aside == {"hash grid": "inside plain()"}
    with report() as aside:
        assert not serves("sample places", x, modules=[nn.Identity()])
        assert serves("sample places", x, modules=[Box()])
    assert aside == {"sample places": "Identity has no loop"}


@pytest.mark.parametrize("options", [[], ["field=qboth", "train=paper", "visibility.cameras=2"]])
def test_a_step_of_shipped_components_is_compiled_throughout(options):
    scene = ["scene.views=4", "train.rays=8"]
    training = trainer(composed("scene=poster", *scene, "hash=C7", "qiren.qubits=3", *options))
    with report() as told:
        for _ in range(3):
            training.take_step(measure=False)
    assert dispatch.described(told) == "all compiled"


def test_a_derived_proposal_network_is_called():
    sampler = SAMPLERS.build("proposal", CubeContraction(), samples=[4], final=2, max_resolutions=[16], levels=1)
    network = sampler.networks[0]
    points = torch.rand(5, 2, 3)
    with report() as told:
        expected = sampler.proposed(network, points, None)
    assert told == {}
    network.__class__ = type("Own", (type(network),), {})
    with report() as told:
        torch.testing.assert_close(sampler.proposed(network, points, None), expected)
    assert told == {"hash grid + MLP": "Own extends ProposalNetwork"}
