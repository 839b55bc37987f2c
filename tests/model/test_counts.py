"""Every parameter count that the paper prints, from the real configuration."""

import csv

from qnerf.building.components import component
from qnerf.building.model import build_field
from qnerf.encoders import ENCODERS
from qnerf.model.labels import hash_tables
from tests.helpers.configs import ROOT, worked_out


def rows(name):
    with (ROOT / "docs" / "tools" / "paper" / f"{name}.csv").open() as file:
        return list(csv.DictReader(file))


def count(module):
    return sum(p.numel() for p in module.parameters())


def field(*overrides):
    return build_field(worked_out(*overrides).settings, views=1, trained=[0])


def circuit(head, label):
    layers, spectral = label.rstrip("S").split("L+")
    return [f"{head}.qiren.layers={layers}", f"{head}.qiren.spectral={spectral}"]


def test_colour_heads_of_the_rgb_table():
    for row in rows("rgb"):
        if row["predictor"] == "qiren":
            overrides = ["field=qcolor", *circuit("color", row["true_layers"])]
        else:
            layers, width = f"color.mlp.layers={row['true_layers']}", f"color.mlp.width={row['true_width']}"
            overrides = ["field=classical", layers, width]
        assert count(field("hash=C7", *overrides).color_head) == int(row["params"]), row


def test_heads_of_the_both_table():
    for row in rows("both"):
        circuits = [*circuit("density", row["true_density"]), *circuit("color", row["true_rgb"])]
        built = field("field=qboth", "encoder=none", *circuits)
        found = count(built.density_head), count(built.color_head)
        assert found == (int(row["density_params"]), int(row["rgb_params"])), row


def test_encoders_of_the_hash_table():
    keys = ("levels", "min_res", "max_res", "log2_table_size", "features_per_level")
    for row in rows("hash"):
        settings = worked_out("field=classical", f"hash={row['config']}").settings
        encoder = component(ENCODERS, settings.encoder, 3)
        assert count(encoder) == int(row["encoding_params"])
        assert encoder.out_dim == int(row["levels"]) * int(row["features_per_level"])
        assert count(field("field=classical", f"hash={row['config']}").density_head) == int(row["mlp_params"])
        assert hash_tables()[row["config"]] == tuple(int(row[key]) for key in keys)


def test_heads_of_the_hsv_study():
    def built(*overrides):
        return build_field(worked_out(*overrides, sweep="hsv").settings, views=1, trained=[0])

    classical = built("field=classical", "geo_features=11", "color.mlp.width=12")
    assert (count(classical.density_head), count(classical.color_head)) == (1200, 531)
    quantum = built()
    assert (count(quantum.density_head), count(quantum.color_head)) == (1166, 1859)
