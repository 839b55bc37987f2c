"""The paper's tables, a function each, with our runs of the same architectures.

A printed parameter count fits exactly one architecture. If the printed label names another, the row is an erratum and
shows both. Our runs are matched by architecture and count, never by the label.
"""

from collections.abc import Callable, Sequence

import pandas as pd
from qnerf.analysis.selection import label
from qnerf.analysis.tables.table import Table

from .joined import joined, printed, side_by_side


def rgb_predictors(frame: pd.DataFrame) -> Table:
    """Colour heads, QIREN and MLP, on a classical density head with a hash encoding."""
    paper = printed("rgb")
    paper["field"] = paper["predictor"].map({"qiren": "qcolor", "mlp": "classical"})
    paper["encoder"] = "hash"
    for source, column in (("true", "color"), ("label", "printed")):
        shapes = paper[["predictor", f"{source}_layers", f"{source}_width"]]
        paper[column] = [_head(*row) for row in shapes.itertuples(index=False)]
    paper["params.color"] = paper["params"]
    table, notes = joined(paper, frame, ["field", "encoder", "color", "params.color"])
    table["printed"] = table["printed"].where(table["printed"] != table["color"])
    columns = {"predictor": "type", "color": "colour head", "printed": "printed as", "params": "colour parameters"}
    return side_by_side(PAPER_TABLES["rgb"][0], table, columns, (*_errata(table, ["color"]), *notes))


def quantum_density_and_rgb(frame: pd.DataFrame) -> Table:
    """QIREN for density and colour, without an encoding."""
    paper = printed("both").assign(field="qboth", encoder="none")
    paper["density"], paper["color"] = _plain(paper["true_density"]), _plain(paper["true_rgb"])
    paper["params.density"], paper["params.color"] = paper["density_params"], paper["rgb_params"]
    table, notes = joined(paper, frame, ["field", "encoder", "density", "color", "params.density", "params.color"])
    labels = _plain(table["label_density"]) + " " + _plain(table["label_rgb"])
    table["printed"] = labels.where(labels != table["density"] + " " + table["color"])
    columns = {
        "density": "density head",
        "color": "colour head",
        "printed": "printed as",
        "density_params": "density parameters",
        "rgb_params": "colour parameters",
    }
    return side_by_side(PAPER_TABLES["both"][0], table, columns, (*_errata(table, ["density", "color"]), *notes))


def hash_encoding_configurations(frame: pd.DataFrame) -> Table:
    """Hash tables C1 to C7 in a classical field. The paper prints their parameter counts only; PSNR is ours."""
    paper = printed("hash").assign(field="classical", encoder="hash")
    paper["hash"] = paper["config"]
    paper["params.density"], paper["params.encoder"] = paper["mlp_params"], paper["encoding_params"]
    table, notes = joined(paper, frame, ["field", "encoder", "hash", "params.density", "params.encoder"])
    columns = {
        "config": "hash table",
        "levels": "levels",
        "min_res": "coarsest",
        "max_res": "finest",
        "log2_table_size": "log2 entries",
        "features_per_level": "features",
        "mlp_params": "density parameters",
        "encoding_params": "encoder parameters",
    }
    erratum = (
        "erratum: the caption gives the columns other names; the encoder has levels x 2^log2 entries x features "
        "parameters"
    )
    return side_by_side(PAPER_TABLES["hash"][0], table, columns, (erratum, *notes))


PAPER_TABLES: dict[str, tuple[str, Callable[[pd.DataFrame], Table]]] = {
    "rgb": (
        "Performance comparison between Quantum (QIREN) and Classical (MLP) RGB predictors in the Q-NeRF and Nerfacto "
        "architectures",
        rgb_predictors,
    ),
    "both": (
        "Performance of the quantum density and quantum RGB Q-NeRF variant using different QIREN configurations",
        quantum_density_and_rgb,
    ),
    "hash": ("Hash encoding configurations used in the ablation study", hash_encoding_configurations),
}
"""Name -> the paper's title, and the function that makes the table from the DataFrame of `load.runs`."""


def _head(predictor: str, layers: str, width: int) -> str:
    return f"{layers}x{width}" if predictor == "mlp" else layers.replace("+", "")


def _plain(names: pd.Series) -> pd.Series:
    return names.str.replace("+", "")


def _errata(table: pd.DataFrame, network: Sequence[str]) -> list[str]:
    """Notes on rows whose label contradicts their parameter count, and on networks that are printed several times."""
    wrong = int(table["printed"].notna().sum())
    notes = [f"errata: {wrong} rows are labelled as another network than their printed parameter count determines"]
    for key, rows in table[table.duplicated(network, keep=False)].groupby(list(network), sort=False):
        values = " and ".join(f"{psnr:.2f} dB" for psnr in rows["psnr_db"])
        notes.append(f"errata: {label(key)} is printed {len(rows)} times, with {values}")
    return notes
