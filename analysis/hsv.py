"""How renderings differ from the truth in colour: hue, saturation and value of their pixels, and the paper's test."""

from collections.abc import Mapping
from itertools import combinations

import numpy as np
import pandas as pd
from matplotlib.colors import rgb_to_hsv
from scipy.stats import ks_2samp

from .images import common_pictures, panels
from .selection import refuse_mixtures, refuse_scenes

SOURCES = ("truth", "classical", "quantum")
CHANNELS = ("hue", "saturation", "value")
GREY = 0.05
"""A pixel of at most this saturation counts as grey: it has no hue."""


def samples(chosen: Mapping[str, pd.DataFrame]) -> pd.DataFrame:
    """The pixels of the held-out views that all chosen runs have readable pictures of, one row each.

    chosen: classical and quantum -> its runs, as `load.runs` gives them, of one configuration and scene. Columns source
    (truth | classical | quantum), seed (of the run; missing for the truth, which occurs once), image, and hue (turns;
    NaN for a grey pixel), saturation and value, all in [0, 1]. ValueError where the runs have no view in common.
    """
    for source, runs in chosen.items():
        refuse_mixtures(runs.assign(source=source), ["source"])
    both = pd.concat(chosen.values())
    refuse_scenes(both, [])
    common, pictures = common_pictures(both["path"])
    if not common:
        without = sum(not own for own in pictures.values())
        raise ValueError(f"no picture that all {len(both)} runs have; {without} of them have none at all")
    pieces = []
    damaged: list[str] = []
    for image in common:
        try:
            strips = {path: panels(pictures[path][image]) for path in both["path"]}
        except ValueError as error:
            damaged.append(f"{image}: {error}")
            continue
        for source, runs in chosen.items():
            for path, seed in zip(runs["path"], runs["seed"], strict=True):
                strip = strips[path]
                pieces.append(pixels(strip["render"]).assign(source=source, seed=seed, image=image))
        pieces.append(pixels(strip["truth"]).assign(source="truth", seed=None, image=image))
    if not pieces:
        raise ValueError(damaged[0])
    table = pd.concat([piece.astype({"seed": "Int64"}) for piece in pieces], ignore_index=True)
    table = table.astype({"source": pd.CategoricalDtype(list(SOURCES)), "image": "category"})
    return table[["source", "seed", "image", *CHANNELS]]


def pixels(image: np.ndarray) -> pd.DataFrame:
    """Hue (turns), saturation and value in [0, 1] of each pixel of an image (H, W, 3) uint8; grey ones have no hue.

    >>> import numpy as np
    >>> pixels(np.array([[[0, 255, 0], [128, 128, 128]]], dtype=np.uint8))["hue"].round(3).tolist()
    [0.333, nan]
    """
    table = pd.DataFrame(rgb_to_hsv(image.reshape(-1, 3) / 255), columns=list(CHANNELS))
    table.loc[table["saturation"] <= GREY, "hue"] = np.nan
    return table


def tests(samples: pd.DataFrame) -> pd.DataFrame:
    """Compares each channel between each two sources, a row per seed that both have; the truth counts for every seed.

    Columns channel, pair, seed, and ks: the Kolmogorov-Smirnov statistic in [0, 1], NaN where a side has no pixel with
    a hue. For hue it depends on where the circle is cut (at red); it is given because the paper gives it.
    """
    groups = dict(list(samples.groupby(["source", samples["seed"].fillna(-1)], observed=True)))
    rows = []
    for first, second in combinations(SOURCES, 2):
        for seed in sorted(own["seed"].iloc[0] for (source, _), own in groups.items() if source == second):
            one = groups.get((first, -1 if first == "truth" else seed))
            if one is None:
                continue
            for channel in CHANNELS:
                a, b = (part[channel].dropna().to_numpy() for part in (one, groups[second, seed]))
                ks = ks_2samp(a, b, method="asymp").statistic if min(len(a), len(b)) else np.nan
                rows.append({"channel": channel, "pair": f"{first} - {second}", "seed": seed, "ks": float(ks)})
    return pd.DataFrame(rows)


def greys(samples: pd.DataFrame) -> pd.Series:
    """Share of pixels without a hue, for each source."""
    return samples["hue"].isna().groupby(samples["source"], observed=True).mean()
