"""Replaces every `auto` in a configuration by a value that fits the scene."""

import copy
import math
from collections.abc import Mapping
from typing import Any

from qnerf.auto.rules import RULES, Measured
from qnerf.config.compatibility import value_of
from qnerf.config.registry import Registry
from qnerf.geometry.contraction import CONTRACTIONS
from qnerf.geometry.pose_refinement import CAMERAS
from qnerf.rendering.shading import SHADINGS
from qnerf.scenes import Scene

AUTO = "auto"
CHOSEN_BY_RULES: dict[str, Registry[Any]] = {"contraction": CONTRACTIONS, "cameras": CAMERAS, "shading": SHADINGS}
"""Group whose component a rule may choose -> the registry of its components."""


def asked(config: Mapping[str, Any]) -> list[str]:
    """The options that are `auto` and have a rule, in the order in which the rules decide."""
    return [option for option in RULES if value_of(config, option) == AUTO]


def resolve(config: Mapping[str, Any], scene: Scene) -> dict[str, Any]:
    """Decides each option that is `auto` from the scene's training data. All other options stay as they are.

    The group `needs` records each decision and the measurements behind it, such as needs.appearance.value and
    needs.appearance.exposure_spread. Options that it has already, as in a stored run, keep the recorded value.

    Raises:
        ValueError: an option that cannot be decided on this scene.
    """
    resolved = copy.deepcopy(dict(config))
    decided = resolved["needs"] = dict(resolved.get("needs") or {})
    measured = Measured(scene)
    for option in asked(config):
        if value_of(resolved, option) != AUTO:  # the component chosen for its group has no such option
            continue
        if option not in decided:
            decision = RULES[option](measured, resolved)
            because = {name: number for name, number in decision.because.items() if math.isfinite(number)}
            decided[option] = {"value": decision.value, **because}
        elif not isinstance(decided[option], Mapping) or "value" not in decided[option]:
            raise ValueError(f"needs.{option}: expected a group with the key value, got {decided[option]!r}")
        replace(resolved, option, decided[option])
    return resolved


def replace(config: dict[str, Any], option: str, decided: Mapping[str, Any]) -> None:
    """Sets a dotted option to its decided value.

    When a component is chosen, options that it does not accept are dropped, and measured ones that are not set are
    added. An option of the hash tables is also set in the encoder.
    """
    group, _, key = option.rpartition(".")
    node = config[group] if group else config
    node[key] = decided["value"]
    if key == "name":
        known = CHOSEN_BY_RULES[group].options(node["name"])
        config[group] = {k: v for k, v in {**decided, **node}.items() if k == "name" or k in known}
    if group == "hash" and config["encoder"].get(key) == AUTO:
        config["encoder"][key] = node[key]
