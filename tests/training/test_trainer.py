import copy
import dataclasses
import re

import pytest
import torch

from qnerf.building.configuration import Configuration
from qnerf.experiment import run
from qnerf.records import read_metrics
from qnerf.timing import STAGES
from qnerf.training.threads import few_products
from qnerf.types import Samples
from tests.helpers.trainer import same, trainer


def test_the_paper_recipe_is_the_papers(config):
    settings = Configuration.of(config("train=paper", "field=qcolor", "qiren=1L2S")).settings
    train = settings.train
    assert (train.steps, train.rays, train.lr, train.lr_final, train.eps) == (30000, 128, 1e-2, 1e-4, 1e-15)
    assert (train.interlevel, train.distortion) == (1.0, 0.002)
    sampler = settings.sampler
    assert (sampler["samples"], sampler["final"], sampler["update_every"]) == ([256, 96], 48, 5)
    assert (sampler["anneal_steps"], sampler["anneal_slope"], sampler["log2_table_size"]) == (1000, 10.0, 17)
    assert sampler["max_resolutions"] == [128, 256]
    assert (settings.render.near, settings.render.far) == (None, None)
    assert settings.visibility.cameras == 0
    head = settings.color["qiren"]
    assert (head["init"], head["gain"], head["sum_layers"], head["input_scale"]) == ("uniform", 1.0, False, 1.0)
    assert (head["center"], head["statistics"]) == (False, "batch")
    assert settings.color["direction_scale"] == 1.0
    assert set(vars(train.rates).values()) == {1.0}  # fixed cameras have no rate of their own
    assert (settings.density["activation"], settings.contraction["name"]) == ("trunc_exp", "linf")


def test_configurations_of_one_seed_see_the_same_batches(tiny):
    drawn = []
    for overrides in (["field=classical"], ["field=qboth", "sampler=uniform", "sampler.samples=5"]):
        taken = trainer(tiny(*overrides))
        taken.take_step(measure=False)
        rays, _ = taken.table.batch(taken.table.draw(8, taken.streams["pixels"]))
        drawn.append((rays.cameras, rays.directions))
    assert torch.equal(drawn[0][0], drawn[1][0])
    assert torch.equal(drawn[0][1], drawn[1][1])


def test_a_measured_step_reports_its_parts(tiny):
    metrics = trainer(tiny("field=qcolor", "cameras=so3xr3")).take_step(measure=True)
    assert {f"time/{part}_ms" for part in STAGES} <= set(metrics)
    parts = ("mse", "interlevel", "distortion", "poses")
    assert metrics["train/loss"] == pytest.approx(sum(metrics[f"train/{name}"] for name in parts), rel=1e-5)
    assert 0 < metrics["time/quantum_ms"] <= metrics["time/field_ms"]


STOP = ("stop.every=2", "stop.share=0.1", "stop.rays=9", "field=classical")


def test_validation_is_of_the_rays_kept_apart_and_changes_nothing(tiny):
    taken = trainer(tiny(*STOP, "field=qboth", "qiren=1L1S", "cameras=so3xr3", "appearance=2"))
    taken.take_step(measure=False)
    before = taken.state()
    kept = {name: value.clone() for name, value in before["model"].items()}
    first, second = taken.validate(), taken.validate()
    assert first == second
    assert 0 < first < 60
    after = taken.state()
    assert all(torch.equal(kept[name], after["model"][name]) for name in kept)
    assert all(torch.equal(before["streams"][name], after["streams"][name]) for name in before["streams"])
    assert all(module.training for module in taken.model.modules())


def test_kept_pixels_are_not_the_same_columns_of_each_image(tiny):
    """The images are 8 wide: one pixel in 4 would be two columns."""
    table = trainer(tiny(*STOP, "stop.share=0.25")).table
    assert table.validation_stride == 5
    assert trainer(tiny("field=classical")).table.validation_stride == 0


def test_a_run_that_no_longer_gains_stops_and_says_so(tiny):
    """Not before its rate falls, after seven tenths of the steps."""
    outcome = run(tiny(*STOP, "train.steps=40", "stop.patience=2", "stop.min_gain_db=50"))
    assert outcome.state == "finished"
    assert (outcome.summary["steps"], outcome.summary["stopped"]) == (34, "plateau")  # the first check is a gain
    assert outcome.summary["psnr"] > 0
    rows = read_metrics(outcome.path)
    assert rows[rows["key"] == "validation/psnr"]["step"].tolist() == [30, 32, 34]
    assert "finished already" in run(tiny(*STOP, "train.steps=40", "stop.patience=2", "stop.min_gain_db=50")).message


def test_a_run_goes_on_on_another_kind_of_device(tiny):
    """Whose random numbers have a state of another size: a CUDA generator's has 16 bytes."""
    taken, other = trainer(tiny()), trainer(tiny())
    taken.take_step(measure=False)
    state = taken.state()
    state["streams"]["samples"] = torch.zeros(16, dtype=torch.uint8)
    other.load(state)
    other.take_step(measure=False)
    assert other.step == 2
    assert all(bool(torch.isfinite(p).all()) for p in other.model.parameters())


def test_a_part_learns_at_its_own_rate(tiny):
    frozen = trainer(tiny("train.rates.color=0", "train.rates.density=0.5"))
    before = [p.detach().clone() for p in frozen.model.field.color_head.parameters()]
    frozen.take_step(measure=False)
    assert all(torch.equal(p, was) for p, was in zip(frozen.model.field.color_head.parameters(), before, strict=True))
    rates = {group["name"]: group["lr"] for group in frozen.optimiser.param_groups}
    assert rates["density"] == pytest.approx(rates["encoder"] / 2)


def test_a_loaded_state_is_the_saved_one_also_after_the_last_step(tiny):
    """A run that is killed between its last checkpoint and its results writes that checkpoint again."""
    one, again = trainer(tiny("train.steps=2")), trainer(tiny("train.steps=2"))
    for _ in range(2):
        one.take_step(measure=False)
        again.load(copy.deepcopy(one.state()))
        assert same(again.state(), one.state())


def test_parts_know_how_much_of_the_training_is_done_also_after_a_resumption(tiny):
    one, again = (trainer(tiny("color=residual", "qiren.qubits=3", "train.steps=4")) for _ in range(2))
    one.take_step(measure=False)
    again.load(one.state())
    assert one.model.field.color_head.progress == again.model.field.color_head.progress == 0.25


UNFIT = {
    "step: expected 0 to 2, got -5": lambda state: state.update(step=-5),
    "optimiser.0.exp_avg: expected torch.float32 [": lambda state: state["optimiser"][0].update(exp_avg=torch.zeros(3)),
    "model: expected the names": lambda state: state["model"].popitem(),
    "field.encoder.table: expected": lambda state: state["model"].update({"field.encoder.table": "3"}),
    "differs in streams: another version of qnerf wrote it": lambda state: state.pop("streams"),
    "differs in later: another version of qnerf wrote it": lambda state: state.update(later=0),
}


def test_a_state_that_does_not_fit_is_one_line_and_changes_nothing(tiny):
    taken, other = trainer(tiny("field=classical")), trainer(tiny("field=classical"))
    taken.take_step(measure=False)
    before = copy.deepcopy(other.state()["model"])
    for message, change in UNFIT.items():
        state = copy.deepcopy(taken.state())
        change(state)
        with pytest.raises(ValueError, match=re.escape(message)) as caught:
            other.load(state)
        assert "\n" not in str(caught.value)
        assert other.step == 0
        assert same(dict(before), dict(other.state()["model"]))
        assert not other.optimiser.state
    other.load(taken.state())


def test_a_part_that_the_loss_does_not_depend_on_has_no_moments(tiny):
    taken, other = (trainer(tiny("field=classical", "train.interlevel=0")) for _ in range(2))
    taken.take_step(measure=False)
    other.load(taken.state())
    taken.take_step(measure=False)
    other.take_step(measure=False)
    assert all(torch.equal(value, other.state()["model"][name]) for name, value in taken.state()["model"].items())


def test_small_steps_run_pytorch_on_one_thread(tiny, monkeypatch):
    torch.set_num_threads(3)
    for few, expected in ((True, [1]), (False, [3])):
        monkeypatch.setattr("qnerf.training.trainer.few_products", lambda *_, few=few: few)
        taken = trainer(tiny("field=classical"))
        seen = []
        taken.model.register_forward_hook(lambda *_, seen=seen: seen.append(torch.get_num_threads()))
        taken.take_step(measure=False)
        assert torch.get_num_threads() == 3
        assert seen == expected


def test_only_steps_that_need_the_interlevel_loss_compute_it(tiny):
    taken = trainer(tiny("field=classical", "sampler.update_every=5"))
    given = []
    terms = taken.terms
    taken.terms = lambda *arguments: given.append(terms(*arguments)) or given[-1]
    for _ in range(13):
        taken.take_step(measure=False)
    assert not taken.model.sampler.learns(13)
    assert taken.take_step(measure=True)["train/interlevel"] > 0
    assert [("interlevel" in found) for found in given] == [True] * 10 + [False] * 3 + [True]


def test_steps_are_small_where_products_are_few(tiny):
    for overrides, few in (
        (["field=qcolor"], True),
        (["field=qcolor", "qiren.method=pennylane"], False),
        (["field=classical", "color.mlp.width=1024", "color.mlp.layers=8"], False),
    ):
        model = trainer(tiny(*overrides)).model
        assert few_products(model, 8192) == few
    own = torch.nn.ModuleList([type("Own", (torch.nn.Module,), {"__module__": "elsewhere"})()])
    assert not few_products(own, 8192)


FEW = ("field=classical", "scene.views=6", "visibility.resolution=16")


def _first(values):
    """What is computed for the first item alone, which a loop would read past."""
    return values[:1]


WRONG = {
    "density_head, one value": ("density_head", lambda y: y[:, 0], r"MLPHead returned: expected float32 \(\d+, 6\)"),
    "density_head, too wide": ("density_head", lambda y: torch.cat([y, y], 1), r"\(\d+, 6\), got float32 \(\d+, 12\)"),
    "color_head, one value": ("color_head", lambda y: y[:, 0], r"MLPHead returned: expected float32 \(\d+, 3\)"),
    "color_head, one row": ("color_head", _first, r"got float32 \(1, 3\)"),
    "color_head, float64": ("color_head", lambda y: y.double(), r"expected float32 .*, got float64"),
    "color_head, a pair": ("color_head", lambda y: (y, y), r"got tuple"),
    "encoder": ("encoder", lambda y: y[:, 1:], r"HashEncoder returned: expected float32 \(\d+, 12\)"),
    "directions": ("directions", _first, r"SphericalHarmonics returned: expected float32 \(256, 16\)"),
    "contraction": ("contraction", lambda y: y[..., :2], r"CubeContraction returned: expected float32 \(\d+, \d+, 3\)"),
    "sampler": (
        "sampler",
        lambda y: dataclasses.replace(y, samples=Samples(y.samples.edges[:1], y.samples.spacing[:1])),
        r"ProposalSampler returned: expected float32 \(256, K \+ 1\), got float32 \(1, \d+\)",
    ),
    "proposals": (
        "sampler",
        lambda y: dataclasses.replace(y, proposals=[(one, weights[:, 1:]) for one, weights in y.proposals]),
        "ProposalSampler returned: expected",
    ),
    "shading": ("shading", lambda y: y._replace(geometry=y.geometry[:1]), "MergeShading returned: expected float32"),
}


@pytest.mark.parametrize("case", WRONG)
def test_a_component_that_returns_the_wrong_thing_is_named_before_a_loop_reads_it(config, case):
    name, wrong, message = WRONG[case]
    one = trainer(config(*FEW))
    module = getattr(one.model.field, name, None) or getattr(one.model, name)
    right = module.forward
    module.forward = lambda *given, **options: wrong(right(*given, **options))
    with pytest.raises(ValueError, match=message):
        one.take_step(measure=False)


def test_activations_poses_and_terms_of_the_loss_are_looked_at_too(config):
    one = trainer(config(*FEW))
    one.model.field.color_activation = lambda raw: raw.sigmoid()[:, 0]
    with pytest.raises(ValueError, match=r"what <lambda> returned: expected float32 \(\d+, 3\)"):
        one.take_step(measure=False)
    one = trainer(config(*FEW, "cameras=se3"))
    one.model.cameras.poses = lambda indices, poses: poses[:1]
    with pytest.raises(ValueError, match=r"SE3Refinement returned: .* \(256, 3, 4\), got float32 \(1, 3, 4\)"):
        one.take_step(measure=False)
    one = trainer(config(*FEW))
    one.loss_terms = lambda rendering, sampled, target, distances: {"mse": (rendering.color - target).square()}
    with pytest.raises(ValueError, match=r"the loss term 'mse': expected a tensor \(\), got float32 \(256, 3\)"):
        one.take_step(measure=False)


def test_a_part_is_idle_until_its_first_gradient(config):
    one = trainer(config(*FEW))
    right = one.model.field.color_head.forward
    one.model.field.color_head.forward = lambda features: right(features).detach()
    one.take_step(measure=False)
    assert one.idle == ["color"]
    one.model.field.color_head.forward = right
    one.take_step(measure=False)
    assert one.idle == []
