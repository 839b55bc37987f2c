"""Short labels of a configuration, made from its resolved values: `qiren.layers=3` is never labelled 1L2S."""

import functools
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import yaml  # type: ignore[import-untyped]

from qnerf.config.folders import CONF
from qnerf.heads import QirenHead, chosen, head_options

HASH_OPTIONS = ("levels", "min_resolution", "max_resolution", "log2_table_size", "features")

FIELDS = {(False, False): "classical", (False, True): "qcolor", (True, False): "qdensity", (True, True): "qboth"}


@functools.cache
def hash_tables() -> dict[str, tuple[int, ...]]:
    """The paper's configurations (conf/hash): name -> the values of `HASH_OPTIONS`."""
    files = {path.stem: yaml.safe_load(path.read_text()) for path in sorted((CONF / "hash").glob("C*.yaml"))}
    return {name: tuple(node[key] for key in HASH_OPTIONS) for name, node in files.items()}


def head_label(node: Mapping[str, Any]) -> str:
    """The label of the chosen head: `2x64` for an MLP of 2 layers, 64 wide; `1L2S` for a circuit head."""
    return chosen(node).label(head_options(node))


def hash_label(encoder: Mapping[str, Any]) -> str:
    """The paper's name of the hash encoder's tables, `auto`, or their numbers joined by dashes."""
    values = tuple(encoder[key] for key in HASH_OPTIONS)
    if "auto" in values:
        return "auto"
    for name, known in hash_tables().items():
        if values == known:
            return name
    return "-".join(str(value) for value in values)


def labels(config: Mapping[str, Any]) -> dict[str, str]:
    """One label per config group and head of what acts; `qiren` where a head is one, `hash` where the encoder is one.

    With other heads than density and color, `field` is classical or quantum.
    """
    groups = ("encoder", "scene", "sampler", "shading", "cameras", "train")
    found = {group: config[group]["name"] for group in groups if group in config}
    if found["encoder"] == "hash":
        found["hash"] = hash_label(config["encoder"])
    heads = {group: config[group] for group in ("density", "color", "head") if group in config}
    found |= {group: head_label(node) for group, node in heads.items()}
    circuits = [head_options(node) for node in heads.values() if issubclass(chosen(node), QirenHead)]
    if circuits:
        found["qiren"] = "+".join(dict.fromkeys(f"{one['layers']}L{one['spectral']}S" for one in circuits))
    quantum = {group: chosen(node).quantum for group, node in heads.items()}
    if quantum.keys() == {"density", "color"}:
        return found | {"field": FIELDS[quantum["density"], quantum["color"]]}
    return found | {"field": "quantum" if any(quantum.values()) else "classical"}


def slug(config: Mapping[str, Any]) -> str:
    """The readable part of a run's id: scene, field, encoder, heads, seed."""
    names = labels(config)
    path = config["scene"].get("path")
    scene = Path(path).name if path else names["scene"]
    encoder = f"hash{names['hash']}" if "hash" in names else names["encoder"]
    heads = [names[group] for group in ("density", "color", "head") if group in names]
    return "-".join([scene, names["field"], encoder, *heads, f"s{config['seed']}"])
