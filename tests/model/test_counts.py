"""Every parameter count that the paper prints, from the real configuration."""

import csv
import re

import pytest
import torch

from qnerf.building.acting import settings_of
from qnerf.building.components import component
from qnerf.building.model import build_field
from qnerf.encoders import ENCODERS
from qnerf.model.labels import HASH_TABLES
from tests.helpers.configs import ROOT, composed


def rows(name: str) -> list[dict[str, str]]:
    with (ROOT / "analysis" / "paper" / f"{name}.csv").open() as file:
        return list(csv.DictReader(file))


def count(module: torch.nn.Module) -> int:
    return sum(p.numel() for p in module.parameters())


def field(*overrides: str):
    return build_field(settings_of(composed(*overrides)), views=1, trained=[0])


def circuit(head: str, label: str) -> list[str]:
    layers, spectral = label.rstrip("S").split("L+")
    return [f"{head}.qiren.layers={layers}", f"{head}.qiren.spectral={spectral}"]


@pytest.mark.parametrize(
    "row", rows("rgb"), ids=lambda row: f"{row['predictor']}-{row['label_layers']}-{row['params']}"
)
def test_colour_heads_of_the_rgb_table(row):
    if row["predictor"] == "qiren":
        overrides = ["field=qcolor", *circuit("color", row["true_layers"])]
    else:
        overrides = [
            "field=classical",
            f"color.mlp.layers={row['true_layers']}",
            f"color.mlp.width={row['true_width']}",
        ]
    assert count(field("hash=C7", *overrides).color_head) == int(row["params"])


@pytest.mark.parametrize("row", rows("both"), ids=lambda row: f"{row['label_density']}-{row['label_rgb']}")
def test_heads_of_the_both_table(row):
    built = field(
        "field=qboth", "encoder=none", *circuit("density", row["true_density"]), *circuit("color", row["true_rgb"])
    )
    assert (count(built.density_head), count(built.color_head)) == (int(row["density_params"]), int(row["rgb_params"]))


@pytest.mark.parametrize("row", rows("hash"), ids=lambda row: row["config"])
def test_encoders_of_the_hash_table(row):
    settings = settings_of(composed("field=classical", f"hash={row['config']}"))
    encoder = component(ENCODERS, settings.encoder, 3)
    assert count(encoder) == int(row["encoding_params"])
    assert count(field("field=classical", f"hash={row['config']}").density_head) == int(row["mlp_params"])
    keys = ("levels", "min_res", "max_res", "log2_table_size", "features_per_level")
    assert HASH_TABLES[row["config"]] == tuple(int(row[key]) for key in keys)


def test_heads_of_the_hsv_study():
    classical = field("experiment=hsv_mlp")
    assert (count(classical.density_head), count(classical.color_head)) == (1200, 531)
    quantum = field("experiment=hsv_2L2S")
    assert (count(quantum.density_head), count(quantum.color_head)) == (1166, 1859)


@pytest.mark.parametrize("path", sorted((ROOT / "conf" / "experiment").glob("*.yaml")), ids=lambda path: path.stem)
def test_an_experiment_that_says_its_count_has_it(path):
    said = re.search(r"^# .*: (\d+) parameters\.$", path.read_text(), re.MULTILINE)
    if said:
        built = field(f"experiment={path.stem}")
        assert int(said[1]) in (count(built.color_head), count(built.density_head))
