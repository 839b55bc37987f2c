"""Short labels of a configuration, made from its resolved values: `qiren.layers=3` is never labelled 1L2S."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from qnerf.heads import chosen, head_options

LABELLED = {
    "hash": ("levels", "min_resolution", "max_resolution", "log2_table_size", "features"),
    "qiren": ("layers", "spectral"),
}
"""Group -> its options that every run's labels name, whether its component is used or not."""

HASH_TABLES = {
    "C1": (16, 16, 2048, 19, 2),
    "C2": (16, 16, 2048, 17, 2),
    "C3": (12, 16, 2048, 17, 2),
    "C4": (12, 16, 2048, 17, 1),
    "C5": (12, 16, 1024, 15, 1),
    "C6": (8, 16, 1024, 15, 1),
    "C7": (8, 16, 1024, 13, 1),
}
"""Levels, coarsest and finest resolution, log2 of the table size, features per entry: the paper's configurations."""

FIELDS = {(False, False): "classical", (False, True): "qcolor", (True, False): "qdensity", (True, True): "qboth"}


def head_label(node: Mapping[str, Any]) -> str:
    """The label of the chosen head: `2x64` for an MLP of 2 layers, 64 wide; `1L2S` for a circuit head."""
    return chosen(node).label(head_options(node))


def hash_label(table: Mapping[str, Any]) -> str:
    """The paper's name of the table, `auto`, or its numbers joined by dashes."""
    values = tuple(table[key] for key in LABELLED["hash"])
    if "auto" in values:
        return "auto"
    for name, known in HASH_TABLES.items():
        if values == known:
            return name
    return "-".join(str(value) for value in values)


def labels(config: Mapping[str, Any]) -> dict[str, str]:
    """One label per config group and head. With one head, which fits a signal, `field` is classical or quantum."""
    groups = ("encoder", "scene", "sampler", "shading", "cameras", "train")
    common = {
        "qiren": f"{config['qiren']['layers']}L{config['qiren']['spectral']}S",
        "hash": hash_label(config["hash"]),
        **{group: config[group]["name"] for group in groups if group in config},
    }
    if "head" in config:
        head = config["head"]
        return common | {"field": "quantum" if chosen(head).quantum else "classical", "head": head_label(head)}
    density, color = config["density"], config["color"]
    field = FIELDS[chosen(density).quantum, chosen(color).quantum]
    return common | {"field": field, "density": head_label(density), "color": head_label(color)}


def slug(config: Mapping[str, Any]) -> str:
    """The readable part of a run's id: scene, experiment, field, encoder, heads, seed."""
    names = labels(config)
    path = config["scene"].get("path")
    scene = Path(path).name if path else names["scene"]
    encoder = f"hash{names['hash']}" if names["encoder"] == "hash" else names["encoder"]
    heads = [names[group] for group in ("density", "color", "head") if group in names]
    parts = [scene, config["experiment"], names["field"], encoder, *heads]
    return "-".join([*filter(None, parts), f"s{config['seed']}"])
