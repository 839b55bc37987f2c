"""A metric is declared once and appears everywhere."""

import io
from collections.abc import Iterator

import pandas as pd
import pytest
from qnerf.analysis import figures, load
from qnerf.analysis.report import content, curves
from qnerf.analysis.report.pictures import Pictures
from qnerf.analysis.tables import ablation
from qnerf.analysis.verdict import evaluations
from rich.console import Console

from qnerf.cli.commands import runs, show
from qnerf.cli.display import print_outcome
from qnerf.experiment import run
from qnerf.metrics import METRICS, Metric, declare, image_metrics, metric_of
from qnerf.records import details
from qnerf.training.image_metrics import IMAGE_METRICS, Comparison


@pytest.fixture
def toy_error(monkeypatch: pytest.MonkeyPatch) -> Iterator[Metric]:
    """One entry and one function."""
    monkeypatch.setattr(IMAGE_METRICS, "_components", dict(IMAGE_METRICS._components))
    metric = declare(Metric("toy_error", "mean absolute error", digits=4, better="lower", kind="image"))

    @IMAGE_METRICS.register("toy_error")
    def mean_absolute_error(view: Comparison) -> float:
        return float((view.color - view.truth).abs().mean())

    yield metric
    del METRICS["toy_error"]


def printed(write, *arguments) -> str:
    out = Console(file=io.StringIO(), width=200)
    write(out, *arguments)
    return out.file.getvalue()


def test_a_new_metric_appears_everywhere(toy_error, tiny, tmp_path):
    outcome = run(tiny("train.steps=2", "train.eval_every=1"))
    views = pd.read_parquet(outcome.path / "eval.parquet")
    assert (views["toy_error"] > 0).all()
    value = views["toy_error"].mean()
    assert outcome.summary["toy_error"] == pytest.approx(value)
    text = f"{value:.4f}"

    assert f"mean absolute error {text}" in " ".join(printed(print_outcome, outcome).split())
    assert "geo_features" not in printed(print_outcome, outcome)
    shown = printed(show.show, details.read(outcome.path))
    assert f"mean absolute error {text}" in shown
    assert f"{views['toy_error'].iloc[0]:.4f}" in shown
    assert "render.near" not in shown  # options are no metrics
    listed = runs.load(str(tmp_path / "runs"), ["toy_error"])
    lines = printed(runs.print_runs, listed, 0, ["toy_error"]).splitlines()
    assert (lines[0].split()[-1], lines[1].split()[-1]) == ("toy_error", text)

    frame = load.runs(tmp_path / "runs")
    table = ablation(frame, ["field"])
    assert table.text["mean absolute error"].tolist() == [text]
    assert evaluations(frame, "toy_error").iloc[0].tolist() == views["toy_error"].tolist()
    assert ablation(frame, ["field"], metric="toy_error").title == "mean absolute error over seeds"

    logged = curves.gather(frame, [0])
    data = content.data(content.prepared(frame), Pictures(), logged)
    assert "toy_error" in data["shown"]
    assert "toy_error" in data["quality"]
    assert data["metrics"]["toy_error"] == {"heading": "mean absolute error", "digits": 4}
    assert logged[0]["eval/toy_error"]["value"][-1] == pytest.approx(value, rel=1e-4)
    assert data["curve_names"]["eval/toy_error"] == "evaluation mean absolute error"
    figure = figures.speed_vs_error(frame, metric="toy_error")
    assert figure.axes[0].get_ylabel() == "mean absolute error"


def test_every_image_metric_has_its_computation():
    assert {metric.key for metric in image_metrics()} == set(IMAGE_METRICS.names())


def test_a_key_is_declared_once():
    with pytest.raises(ValueError, match="metric 'psnr' is declared already, as 'PSNR'"):
        declare(Metric("psnr", "another"))


def test_columns_and_logged_keys_have_their_metrics():
    for key, heading, text in (
        ("psnr", "PSNR, dB", "21.50"),
        ("eval/psnr", "evaluation PSNR, dB", "21.50"),
        ("validation/psnr", "validation PSNR, dB", "21.50"),
        ("train/loss", "training loss", "21.50000"),
        ("time/step_ms", "time of a step, ms", "21.5"),
        ("params.total", "parameters", "22"),
        ("train.lr", "train.lr", "21.5"),
        ("other/psnr", "other/psnr", "21.5"),
    ):
        metric = metric_of(key)
        assert (metric.heading, metric.text(21.5)) == (heading, text)


def test_signs_and_thousands():
    assert metric_of("psnr").text(0.5, sign="+") == "+0.50"
    assert metric_of("params.total").text(1_055_947) == "1,055,947"
    assert [metric_of(key).sign for key in ("psnr", "lpips", "params.total")] == [1, -1, 1]
