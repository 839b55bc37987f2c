"""`numerics.finite_checks=true` names where the first value that is not finite arose; `qnerf replay` finds it again."""

import math
import os
import pickle
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor

from qnerf import experiment
from qnerf.building.model import build_model, ray_table
from qnerf.building.scene import build_scene
from qnerf.cli import main
from qnerf.config.identity import identity
from qnerf.config.settings import settings_from
from qnerf.quantum import QuantumLayer
from qnerf.records import read_status
from qnerf.rendering.render import render
from qnerf.timing import Stopwatch
from qnerf.training import checked_trainer, finite_checks, trainer
from qnerf.training.checked_trainer import BACKWARD, FILE, CheckedTrainer, RunContext
from qnerf.training.finite_checks import NonFinite
from qnerf.training.trainer import Diverged, Trainer

NAN = math.nan
SMALL = ("qiren=1L1S", "qiren.qubits=3", "numerics.finite_checks=true")
WIDTH = 8  # of the tiny scene's images

Make = Callable[..., CheckedTrainer]
Capture = pytest.CaptureFixture[str]


@pytest.fixture
def file(tmp_path: Path) -> Path:
    return tmp_path / FILE


@pytest.fixture
def checked(tiny: Callable[..., dict[str, Any]], file: Path) -> Make:
    """`checked("field=qboth")`: a checked trainer that writes `file`."""

    def make(*overrides: str) -> CheckedTrainer:
        config = tiny(*SMALL, *overrides)
        settings = settings_from(config)
        scene = build_scene(settings)
        model = build_model(settings, scene)
        watch = Stopwatch(settings.torch_device, model, QuantumLayer)
        context = RunContext(scene.names, config, file)
        return CheckedTrainer(model, ray_table(settings, scene), settings, watch, context)

    return make


def found(trainer: CheckedTrainer) -> NonFinite:
    with pytest.raises(NonFinite) as caught:
        trainer.take_step(measure=False)
    assert "\n" not in str(caught.value)
    assert f"step {trainer.step}" in str(caught.value)
    return caught.value


def replayed(file: Path, capsys: Capture) -> tuple[int, str]:
    capsys.readouterr()
    code = main.dispatch("replay", [str(file)])
    out, err = capsys.readouterr()
    return code, out + err


def again(error: NonFinite) -> tuple[int, str]:
    """What `replayed` gives where the step ends as it did."""
    return 1, f"then: {error.message}\nnow:  {error.message}\nthe same\n"


def plant(tensor: Tensor, *index: int, value: float = NAN) -> None:
    with torch.no_grad():
        tensor[index] = value


def name_of(trainer: CheckedTrainer, ray: int) -> str:
    """How a message names a ray of the last batch."""
    view, pixel = int(trainer.table.last[0].cameras[ray]), int(trainer.table.last_pixels[ray])
    return f"ray {ray} of the batch, camera images/{view:03d}.png, pixel x={pixel % WIDTH} y={pixel // WIDTH}"


def test_nan_in_a_table_entry(checked: Make, file: Path, capsys: Capture) -> None:
    before = checked("field=qboth", "visibility.cameras=0")
    before.take_step(measure=False)
    table = before.model.field.encoder.table
    entry = table.grad.nonzero()[-1].tolist()  # one that the first step reads
    taken = checked("field=qboth", "visibility.cameras=0")
    plant(taken.model.field.encoder.table, *entry)
    error = found(taken)
    assert error.where == "encoder"
    rows = error.values.isnan().any(1).nonzero()[:, 0]
    assert error.values.isnan().nonzero()[0].tolist() == [int(rows[0]), entry[0]]
    assert error.ray == int(rows[0]) // (len(error.values) // 8)
    assert name_of(taken, error.ray) in str(error)
    assert replayed(file, capsys) == again(error)


@pytest.mark.parametrize("ray", [0, 5])
def test_nan_at_points_of_one_ray_where_others_are_left_out(checked: Make, ray: int) -> None:
    taken = checked("field=qcolor", "visibility.cameras=3")
    unit: list[Tensor] = []
    taken.model.field.contraction.register_forward_hook(lambda _, __, out: unit.append(out))

    def spoil(_: object, given: tuple[Tensor], out: Tensor) -> Tensor:
        own = (given[0][:, None] == unit[-1][ray]).all(-1).any(1)
        assert 0 < len(own) <= unit[-1].shape[:-1].numel()
        return torch.where(own[:, None], NAN, out)

    taken.model.field.encoder.register_forward_hook(spoil)
    error = found(taken)
    assert (error.where, error.ray) == ("encoder", ray)


def test_nan_in_the_ray_of_an_image_s_pixel(checked: Make, file: Path, capsys: Capture) -> None:
    before = checked("field=classical")
    before.take_step(measure=False)
    taken = checked("field=classical")
    pixel = int(before.table.last_pixels[3])
    plant(taken.table.directions, pixel, 1)
    error = found(taken)
    assert error.where == "rays (directions)"
    first = before.table.last_pixels.tolist().index(pixel)
    assert error.ray == first
    assert name_of(before, first) in str(error)
    assert replayed(file, capsys) == again(error)  # the scene itself is sound: the file holds the ray


def test_nan_in_a_gradient_hook(checked: Make, file: Path, capsys: Capture) -> None:
    taken = checked("field=qboth")
    weights = dict(taken.model.named_parameters())["field.density_head.readout.weight"]
    weights.register_hook(lambda gradient: gradient * NAN)
    error = found(taken)
    assert error.where == "gradient of field.density_head.readout.weight"
    assert error.ray is None
    assert taken.step == 0
    code, out = replayed(file, capsys)
    assert code == 0  # the model in the file has no such hook
    assert out.endswith("now:  every value is finite; it does not occur here\n")


def test_a_gradient_that_overflows(checked: Make, file: Path, capsys: Capture) -> None:
    taken = checked("field=classical")
    first, _, final = taken.model.field.density_head.net
    with torch.no_grad():  # every value on the way forward is small
        taken.model.field.encoder.table.fill_(1e6)
        first.weight.zero_()
        first.bias.copy_(torch.eye(64)[0] * 1e-42)
        final.weight[0] = 3e38
    error = found(taken)
    assert error.where == "gradient of field.density_head.net.0.weight"
    assert replayed(file, capsys) == again(error)


@pytest.mark.parametrize(("field", "head"), [("qdensity", "density head"), ("qcolor", "colour head")])
def test_nan_in_a_circuit_s_input(checked: Make, file: Path, capsys: Capture, field: str, head: str) -> None:
    taken = checked(f"field={field}")
    hybrid = {"qdensity": taken.model.field.density_head, "qcolor": taken.model.field.color_head}[field].hybrid
    plant(hybrid[1].linear.bias, 2)
    error = found(taken)
    assert error.where == f"inputs of circuit 1 of the {head}"
    assert error.values.isnan().any(0).tolist() == [False, False, True]
    assert error.ray is None  # every ray has it
    assert "ray" not in error.message
    assert replayed(file, capsys) == again(error)


@pytest.mark.parametrize(
    "gate", [[], ["shading=top", "shading.samples=1"], ["shading=merge", "shading.parts=2"]], ids=str
)
def test_nan_in_one_camera_s_appearance(checked: Make, gate: list[str]) -> None:
    taken = checked("field=qcolor", "appearance=2", *gate)
    plant(taken.model.field.appearance.weight, 3, 1)
    error = found(taken)
    assert error.where == "inputs of colour head"
    assert error.ray == taken.table.last[0].cameras.tolist().index(3)
    assert name_of(taken, error.ray) in str(error)


def test_nan_in_a_loss_term(checked: Make, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(trainer, "distortion", lambda samples, weights: weights.sum() * math.inf)
    assert found(checked("field=classical", "train.distortion=0.1")).where == "loss term distortion"


def test_nan_in_the_optimiser(checked: Make, file: Path, capsys: Capture) -> None:
    taken = checked("field=qcolor")
    taken.take_step(measure=False)
    parameter = taken.model.field.color_head.readout.bias
    plant(taken.optimiser.state[parameter]["exp_avg_sq"], 1)
    error = found(taken)
    assert error.where == "parameters after the step, field.color_head.readout.bias"
    assert replayed(file, capsys) == again(error)


def test_infinite_weights_of_a_proposal(checked: Make) -> None:
    taken = checked("field=classical")
    plant(taken.model.sampler.networks[1].out.bias, 0)
    error = found(taken)
    assert (error.where, error.ray) == ("weights of proposal network 1", None)


def test_every_part_with_parameters_has_its_place_in_the_backward_order(checked: Make) -> None:
    assert set(checked("appearance=2", "cameras=se3").model.parts) == set(BACKWARD)


def test_pose_refinement_is_repeated_with_its_gradients(checked: Make, file: Path, capsys: Capture) -> None:
    taken = checked("field=classical", "cameras=so3xr3")
    taken.take_step(measure=False)
    plant(taken.optimiser.state[taken.model.cameras.motion]["exp_avg"], 0, 4, value=math.inf)
    error = found(taken)
    assert error.where == "parameters after the step, cameras.motion"
    assert replayed(file, capsys) == again(error)


def test_checks_change_no_number_and_leave_no_hook(checked: Make, tiny: Callable[..., dict[str, Any]]) -> None:
    overrides = ("field=qboth", "cameras=se3", "shading=top", "train.distortion=0.01")
    looked = checked(*overrides)
    settings = settings_from(tiny(*SMALL, *overrides))
    scene = build_scene(settings)
    model = build_model(settings, scene)
    plain = Trainer(model, ray_table(settings, scene), settings, Stopwatch(settings.torch_device, model, QuantumLayer))
    for _ in range(3):
        assert looked.take_step(measure=True)["train/loss"] == plain.take_step(measure=True)["train/loss"]
    for a, b in zip(looked.model.state_dict().values(), plain.model.state_dict().values(), strict=True):
        assert torch.equal(a, b)
    assert hooks(looked.model) == hooks(plain.model)  # the stopwatch's


def hooks(model: torch.nn.Module) -> list[tuple[int, int, int]]:
    return [(len(m._forward_pre_hooks), len(m._forward_hooks), len(m._backward_hooks)) for m in model.modules()]


def test_a_run_without_the_option_is_not_looked_at(
    tiny: Callable[..., dict[str, Any]], monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(*_: object) -> None:
        raise AssertionError

    for module in (finite_checks, checked_trainer):
        monkeypatch.setattr(module, "check_finite", refuse)
    config = tiny("field=qboth", "qiren=1L1S", "qiren.qubits=3")
    assert experiment.run(config).state == "finished"
    assert identity(config) == identity(tiny("field=qboth", *SMALL))


def test_a_run_that_diverges_goes_on_with_checks_and_names_the_part(
    tiny: Callable[..., dict[str, Any]], capsys: Capture
) -> None:
    config = tiny("field=classical", "train.lr=1e6", "train.lr_final=1e6", "train.steps=8")
    with pytest.raises(Diverged, match="the same command with numerics"):
        experiment.run(config)
    with pytest.raises(NonFinite, match="`qnerf replay ") as caught:
        experiment.run(config | {"numerics": {"dtype": "float32", "finite_checks": True}})
    (folder,) = (path for path in Path(config["store"]).iterdir() if (path / "config.yaml").exists())
    assert read_status(folder)["error"] == str(caught.value)
    assert replayed(folder / FILE, capsys) == again(caught.value)


def test_replay_takes_another_place_of_the_scene(checked: Make, file: Path, tmp_path: Path, capsys: Capture) -> None:
    taken = checked("field=qcolor")
    plant(taken.model.field.color_head.hybrid[0].linear.bias, 0)
    error = found(taken)
    (tmp_path / "scene").rename(tmp_path / "moved")
    assert "scene" in replayed(file, capsys)[1]
    assert main.dispatch("replay", [str(file), "--scene", str(tmp_path / "moved")]) == 1
    assert capsys.readouterr().out == again(error)[1]


@pytest.mark.parametrize("damage", ["no rays", "another shape", "colours of another shape"])
def test_a_file_without_the_rays_of_the_step_is_one_line(
    checked: Make, file: Path, capsys: Capture, damage: str
) -> None:
    taken = checked("field=classical")
    plant(taken.model.field.encoder.table, slice(None), 0)
    found(taken)
    content = torch.load(file)
    if damage == "no rays":
        content["rays"] = {}
    elif damage == "another shape":
        content["rays"]["origins"] = content["rays"]["origins"][:3]
    else:
        content["colors"] = content["colors"][:, :2]
    torch.save(content, file)
    code, out = replayed(file, capsys)
    assert code == 2
    assert out.count("\n") <= 3
    assert "Traceback" not in out


class Command:
    """Unpickling it runs a shell command."""

    def __init__(self, command: str) -> None:
        self.command = command

    def __reduce__(self) -> tuple[Any, ...]:
        return os.system, (self.command,)


@pytest.mark.parametrize("kind", ["pickle", "archive", "other content", "text", "absent"])
def test_a_hostile_file_is_refused_in_one_line(tmp_path: Path, capsys: Capture, kind: str) -> None:
    file = tmp_path / FILE
    command = Command(f"touch {tmp_path / 'owned'}")
    if kind == "pickle":
        file.write_bytes(pickle.dumps(command))
    elif kind == "archive":
        torch.save({"told": command}, file)
    elif kind == "other content":
        torch.save({"told": "nan", "state": {}}, file)
    elif kind == "text":
        file.write_text("no archive")
    code, told = replayed(file, capsys)
    assert code == 2
    assert told.startswith("error: ")
    assert str(file) in told
    assert told.count("\n") == 1
    assert not (tmp_path / "owned").exists()


def test_nan_while_the_occupancy_is_looked_at(checked: Make, file: Path, capsys: Capture) -> None:
    """It comes before the rays: the value belongs to none of them."""
    taken = checked("field=qdensity", "occupancy.every=2", "occupancy.after=1", "visibility.resolution=8")
    taken.take_step(measure=False)
    plant(taken.model.field.density_head.hybrid[0].linear.bias, 1)
    error = found(taken)
    assert error.where == "inputs of circuit 0 of the density head"
    assert len(error.values) == len(taken.model.field.mask.cells)
    assert "ray" not in error.message
    assert replayed(file, capsys) == again(error)


def test_nan_in_one_depth_of_the_rendering(checked: Make, monkeypatch: pytest.MonkeyPatch) -> None:
    def spoilt(*given: Any, **options: Any) -> tuple[Any, Any]:
        rendering, behind = render(*given, **options)
        return replace(rendering, depth=rendering.depth + torch.where(torch.arange(8) == 6, NAN, 0.0)), behind

    monkeypatch.setattr("qnerf.model.model.render", spoilt)
    error = found(checked("field=classical"))
    assert (error.where, error.ray) == ("rendering (depth)", 6)
