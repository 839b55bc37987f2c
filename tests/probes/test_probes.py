"""What the probes write about trained models, against independent computations."""

import shutil
import sys
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from qnerf.cli.commands import probe as probe_command
from qnerf.cli.main import main
from qnerf.experiment import run
from qnerf.heads import HEADS
from qnerf.probes import PROBES, Trained, cost, diagnostics, load, probe, spectrum
from qnerf.quantum import QuantumLayer, lightcone
from qnerf.quantum.circuit import Amplitudes, Circuit, Gate, Weights, feature, weight
from qnerf.quantum.cones import find_cones
from qnerf.quantum.diagnostics import weights_of
from qnerf.quantum.program import program
from qnerf.quantum.statevector import PlainCircuit
from qnerf.records.read import read_probe
from tests.helpers.trainer import built


def layer(wires: int, spectral: int, seed: int = 0, ansatz: str = "qiren") -> QuantumLayer:
    torch.manual_seed(seed)
    return QuantumLayer(wires, spectral, ansatz=ansatz).double()


def of(table: pd.DataFrame, output: int, wire: int) -> np.ndarray:
    rows = table[(table["output"] == output) & (table["wire"] == wire)]
    return rows.sort_values("frequency")["power"].to_numpy()


def untrained(config) -> Trained:
    """A model as it is built, in the place of a trained one."""
    made = built(config)
    return Trained(Path(), made.settings, made.scene, made.model.eval(), 0)


def command(monkeypatch, *arguments: str) -> int:
    monkeypatch.setattr(sys, "argv", ["qnerf", "probe", *arguments])
    with pytest.raises(SystemExit) as stop:
        main()
    return int(stop.value.code or 0)


def test_spectrum_of_one_uploading_is_that_of_the_light_cone_polynomial():
    circuit = layer(8, 1)
    table = spectrum.powers(circuit)
    assert set(table["method"]) == {"exact"}
    cones = find_cones(program(circuit.circuit))
    own = lightcone.LightCones(cones)
    values = PlainCircuit(circuit.circuit).evaluate(torch.from_numpy(own.grid.points), weights_of(circuit).double())
    coefficients = own.coefficients(values).numpy()
    half = np.array([1, 0.5, 0.5])  # mean squares of 1, cos, sin
    for output, cone in enumerate(cones.cones):
        square = coefficients[output].reshape(3, 3, 3) ** 2 * np.einsum("a,b,c->abc", half, half, half)
        for axis, wire in enumerate(cone.features):
            marginal = square.sum(tuple({0, 1, 2} - {axis}))
            np.testing.assert_allclose(of(table, output, wire), [marginal[0], marginal[1:].sum()], atol=1e-15)
        for wire in set(range(8)) - set(cone.features):
            np.testing.assert_allclose(of(table, output, wire), [square.sum()], atol=1e-15)


@settings(max_examples=20)
@given(st.integers(1, 3), st.integers(1, 3), st.integers(0, 1000), st.sampled_from(["qiren", "cnot", "ry"]))
def test_spectrum_adds_up_to_the_mean_square(wires, spectral, seed, ansatz):
    circuit = layer(wires, spectral, seed, ansatz)
    table = spectrum.powers(circuit)
    steps = torch.arange(2 * spectral + 1, dtype=torch.float64) * (2 * torch.pi / (2 * spectral + 1))
    grid = torch.cartesian_prod(*[steps] * wires).reshape(-1, wires)
    values = circuit(grid).detach().numpy()
    for (output, _), rows in table.groupby(["output", "wire"]):
        assert rows["power"].sum() == pytest.approx((values[:, output] ** 2).mean(), abs=1e-13)
        assert rows["mean"].iloc[0] == pytest.approx(values[:, output].mean(), abs=1e-13)
        assert rows["variance"].iloc[0] == pytest.approx(values[:, output].var(), abs=1e-13)


def test_spectrum_of_scaled_encodings_has_their_frequencies():
    table = spectrum.powers(layer(2, 2, ansatz="ternary"))
    assert sorted(table["frequency"].unique()) == [0, 1, 2, 3, 4]  # sums and differences of 1 and 3


def test_spectrum_by_sobol_points_is_the_exact_one_within_its_standard_error():
    circuit = layer(4, 2)
    exact, estimate = spectrum.powers(circuit), spectrum.powers(circuit, max_values=0)
    assert set(estimate["method"]) == {"sobol"}
    assert estimate[["output", "wire", "frequency"]].equals(exact[["output", "wire", "frequency"]])
    above_rounding = exact["power"] > 1e-12  # below, both are rounding errors
    deviation = (estimate["power"] - exact["power"])[above_rounding] / estimate["standard_error"][above_rounding]
    assert deviation.abs().max() < 6
    assert 0.5 < deviation.std() < 2
    assert estimate["standard_error"].max() < 1e-2 * exact["power"].max()


def test_spectrum_of_a_run_has_each_circuit_of_each_head(quantum_run):
    trained = load(quantum_run)
    table = pd.read_parquet(probe(trained, "spectrum"))
    assert table.groupby(["head", "circuit"]).ngroups == 4
    second = trained.model.field.color_head.hybrid[1]
    own = table[(table["head"] == "color") & (table["circuit"] == 1)]
    columns = ["output", "wire", "frequency", "power"]
    pd.testing.assert_frame_equal(own[columns].reset_index(drop=True), spectrum.powers(second.circuit)[columns])
    scale = second.input_scale * second.norm.weight.detach().abs().double()
    np.testing.assert_allclose(own.groupby("wire")["angle_std"].first(), scale, rtol=1e-6)
    fourier, hybrid = HEADS.build("qfgn", 3, 2, qubits=2).hybrid
    assert spectrum.angles(fourier, 2)["angle_std"].isna().all()
    assert spectrum.angles(hybrid, 2)["angle_std"].notna().all()


def test_diagnostics_of_a_run_are_saved_and_shown(quantum_run, monkeypatch, capsys):
    for name, value in {"STATES": 50, "FISHER_INPUTS": 4, "KERNEL_INPUTS": 20, "SAMPLES": 400}.items():
        monkeypatch.setattr(diagnostics, name, value)
    names = ["expressibility", "entangling", "fisher", "kernel", "surrogate"]
    assert command(monkeypatch, str(quantum_run), *names) == 0
    tables = {name: read_probe(quantum_run, name) for name in names}
    assert all(set(table["head"]) == {"density", "color"} for table in tables.values())
    fisher = tables["fisher"].query("head == 'color' and circuit == 0")
    assert len(fisher) == fisher["parameters"].iloc[0] == 36
    assert 0 < fisher["rank"].iloc[0] < 36  # the first phi and the last omega have no effect
    assert tables["kernel"].query("head == 'color' and circuit == -1").shape[0] == 20
    assert tables["surrogate"].query("covered")["error"].max() < 1e-3  # 13 waves are the whole spectrum
    assert capsys.readouterr().out.count("effective_rank") == 1


def test_cost_counts_what_is_evaluated(quantum_run, monkeypatch, capsys):
    trained = load(quantum_run)
    before = {name: value.clone() for name, value in trained.model.state_dict().items()}
    table = PROBES["cost"](trained)
    assert all(torch.equal(value, before[name]) for name, value in trained.model.state_dict().items())
    assert table[["head", "circuit"]].values.tolist() == [[head, n] for head in ("density", "color") for n in range(2)]
    pixels = len(trained.ray_table().view(0))
    samples = trained.settings.sampler["final"]
    angles = 6 * 2 * (2 + 1) + 2 * 2  # of 2 wires, 2 sublayers and 2 re-uploadings
    density = table.query("head == 'density'")
    assert set(density["view"]) == {pixels * samples}
    assert set(density["step"]) == {trained.settings.train.rays * samples * (1 + 2 * angles)}
    np.testing.assert_allclose(density["view_hours"], pixels * samples * 1000 / 1e4 / 3600)
    assert command(monkeypatch, str(quantum_run), "cost") == 0
    assert capsys.readouterr().out.count("density") == 2


def test_cost_counts_gates_after_their_decomposition():
    def counts(*gates):
        circuit = Circuit("own", 3, gates, (((0, "Z"),),), weights=(Weights("w", (16,)),))
        return cost.gate_counts(circuit)[1], cost.shifts(circuit)

    w = [weight("w", index) for index in range(16)]
    assert counts(Gate("Toffoli", (0, 1, 2))) == (6, 1)
    assert counts(Gate("SWAP", (0, 1)), Gate("CRY", (0, 2), (w[0],))) == (5, 5)
    assert counts(Gate("MultiRZ", (0, 1, 2), (w[1],)), Gate("RX", (0,), (feature(0),))) == (4, 5)
    assert counts(Amplitudes((0, 1, 2), tuple(w[:8]))) == (2**3 - 2, 1 + 2 * 7)
    assert counts(Amplitudes((0, 1, 2), tuple(w[:8]), tuple(w[8:]))) == (2 * (2**3 - 2), 1 + 2 * 14)


def test_cost_of_an_amplitude_head_includes_the_preparation():
    head = HEADS.build("amplitude", 8, 3, registers=[3, 2], layers=1, uploads=1, joint=True)
    (system,) = head.systems
    circuit = cost.circuit_of(system)
    prepared = (2**3 - 2) + (2**2 - 2)
    assert cost.gate_counts(circuit)[1] == prepared + 2 * 5  # and two rings of CZ
    assert cost.shifts(circuit) == 1 + 2 * (7 + 3 + 2 * 5 + 5)
    with pytest.raises(ValueError, match="unitary=dense, which is a matrix"):
        cost.circuit_of(HEADS.build("amplitude", 8, 3, unitary="dense").systems[0])


def test_cost_of_a_view_is_one_evaluation_of_each_circuit_for_each_sample(tiny):
    for head in ("amplitude", "parallel", "product", "frequencies", "qvf", "qiren_bypass"):
        options = () if head != "qiren_bypass" else ("qiren.qubits=2", "qiren.layers=1")
        built = untrained(tiny(f"head@density={head}", "head@color=mlp", "visibility.cameras=0", *options))
        samples = len(built.ray_table().view(0)) * built.settings.sampler["final"]
        assert set(PROBES["cost"](built).query("head == 'density'")["view"]) == {samples}, head


def test_units_that_never_act_are_dead(tiny):
    built = untrained(tiny("field=classical", "color.mlp.layers=4", "color.mlp.width=5"))
    with torch.no_grad():
        built.model.field.color_head.net[2].bias.copy_(torch.tensor([-1e6, -1e6, -1e6, 1e6, 1e6]))
    table = PROBES["units"](built)
    rows = table[(table["head"] == "color") & (table["kind"] == "relu")].set_index(["when", "layer"])
    assert rows.loc[("end", 1), "dead"] == pytest.approx(0.6)
    assert rows.loc[("start", 1), "dead"] < 0.6
    assert rows["units"].tolist() == [5] * 6
    outputs = table[table["kind"] == "output"]
    assert len(outputs) == 4
    assert outputs["dead"].isna().all()
    assert (outputs["std"] > 0).all()


def test_units_of_circuits_are_their_measured_values(quantum_run):
    table = PROBES["units"](load(quantum_run))
    circuits = table[table["kind"] == "circuit"]
    assert len(circuits) == 8  # two heads of two circuits, before and after
    assert circuits["std"].between(0, 1).all()
    assert (circuits["units"] == 2).all()


def test_command_writes_what_is_asked_for(quantum_run, tmp_path, monkeypatch, capsys):
    assert set(probe_command.PROBES) == set(PROBES)
    path = shutil.copytree(
        quantum_run, tmp_path / quantum_run.name, ignore=lambda *_: ["units.parquet", "spectrum.parquet"]
    )
    assert command(monkeypatch, str(path), "units", "spectrum") == 0
    assert capsys.readouterr().out.split() == [str(path / "units.parquet"), str(path / "spectrum.parquet")]
    assert not (path / "eval_hardware.parquet").exists()
    assert command(monkeypatch, str(path), "shots=10", "views=1") == 0
    assert (path / "eval_hardware.parquet").exists()


def test_probe_command_says_mistakes_in_one_line(tiny, tiny_scene, monkeypatch, capsys):
    path = run(tiny("field=classical")).path

    def refused(*arguments: str) -> str:
        assert command(monkeypatch, str(path), *arguments) == 2
        error = capsys.readouterr().err
        assert error.count("\n") == 1
        return error

    for arguments, message in (
        (["unit"], "unknown probe 'unit'; known: spectrum, units"),
        (["units", "shot=1"], "unknown option 'shot'; known: shots"),
        (["spectrum"], "neither of its heads has a circuit of qnerf"),
        (["shots=10"], "neither of its heads has a circuit of qnerf"),
        (["views=-1"], "views must be between 0 and 1000000000, got -1"),
        (["shots=10", "seed=1,2"], "seed expects int, got '1,2'"),
        (["noise=thermal"], "noise=thermal also expects probabilities, such as p=0.001,0.01"),
    ):
        assert message in refused(*arguments)
    sound = (path / "checkpoint.pt").read_bytes()
    for content in (b"", b"PK no archive", sound[:1000]):
        (path / "checkpoint.pt").write_bytes(content)
        assert "checkpoint.pt: expected the checkpoint of this run, got " in refused("units")
    (path / "checkpoint.pt").write_bytes(sound)
    (tiny_scene / "images" / "000.png").write_bytes((tiny_scene / "images" / "001.png").read_bytes())
    assert "the scene's contents are not those that the run was started with" in refused("units")
    assert not (path / "units.parquet").exists()


def test_load_refuses_runs_that_are_not_finished(tmp_path):
    with pytest.raises(ValueError, match="is not a run"):
        load(tmp_path)
    (tmp_path / "config.yaml").write_text("seed: 0")
    with pytest.raises(ValueError, match="expected a finished run, this one is interrupted"):
        load(tmp_path)
