"""How renderings differ from the truth in colour: distributions of hue, saturation and value, tests, effect sizes."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import combinations

import numpy as np
import pandas as pd
from matplotlib.colors import rgb_to_hsv
from scipy.stats import ks_2samp, wasserstein_distance

from qnerf.cli.numbers import share
from qnerf.records.filters import require

from . import circular, command
from .images import common_pictures, panels
from .selection import refuse_mixtures, refuse_scenes, select
from .tables.table import Table

SOURCES = ("truth", "classical", "quantum")
CHANNELS = ("hue", "saturation", "value")
GREY = 0.05
"""A pixel of at most this saturation counts as grey: it has no hue."""

CLASSICAL = {"field": "classical"}
QUANTUM = {"field": "qcolor"}
EFFECTS = ("ks", "cliffs_delta", "wasserstein", "direction")
"""The statistics of `compare`. None grows with the number of pixels, as p-values of such samples would."""


def samples(
    frame: pd.DataFrame,
    *,
    classical: str | Mapping[str, object] = CLASSICAL,
    quantum: str | Mapping[str, object] = QUANTUM,
    grey: float = GREY,
    problems: list[str] | None = None,
) -> pd.DataFrame:
    """The pixels of the held-out views that all chosen runs have readable pictures of, one row each.

    Args:
        frame: runs as `load.runs` gives them.
        classical, quantum: conditions that choose the runs to compare; see `qnerf.records.filters`.
        grey: a pixel of at most this saturation has no hue.
        problems: gets a line for each view that is left out because a picture of it is damaged.

    Returns:
        Columns source (truth | classical | quantum), seed (of the run; missing for the truth, which occurs once),
        image, and hue (in turns; NaN for a grey pixel), saturation and value, all in [0, 1].

    Raises:
        ValueError: nothing is chosen, or several scenes or configurations, or runs that have no view in common.
    """
    finished = select(frame).runs
    chosen = {"classical": require(finished, classical), "quantum": require(finished, quantum)}
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
                pieces.append(pixels(strip.render, grey).assign(source=source, seed=seed, image=image))
        pieces.append(pixels(strip.truth, grey).assign(source="truth", seed=None, image=image))
    if problems is not None:
        problems += damaged
    if not pieces:
        raise ValueError(damaged[0])
    table = pd.concat([piece.astype({"seed": "Int64"}) for piece in pieces], ignore_index=True)
    table = table.astype({"source": pd.CategoricalDtype(list(SOURCES)), "image": "category"})
    return table[["source", "seed", "image", *CHANNELS]]


def pixels(image: np.ndarray, grey: float = GREY) -> pd.DataFrame:
    """Hue (turns), saturation and value in [0, 1] of each pixel of an image (H, W, 3) uint8; grey ones have no hue.

    >>> import numpy as np
    >>> pixels(np.array([[[0, 255, 0], [128, 128, 128]]], dtype=np.uint8))["hue"].round(3).tolist()
    [0.333, nan]
    """
    table = pd.DataFrame(rgb_to_hsv(image.reshape(-1, 3) / 255), columns=list(CHANNELS))
    table.loc[table["saturation"] <= grey, "hue"] = np.nan
    return table


def tests(samples: pd.DataFrame) -> pd.DataFrame:
    """Compares each channel between each two sources, a row per seed that both have; the truth counts for every seed.

    Columns channel, pair, seed and those of `compare`.
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
                rows.append({"channel": channel, "pair": f"{first} - {second}", "seed": seed} | compare(a, b, channel))
    return pd.DataFrame(rows)


def compare(first: np.ndarray, second: np.ndarray, channel: str) -> dict[str, float]:
    """Compares two samples of a channel. All statistics are NaN if a sample is empty.

    n_first, n_second: sizes of the samples.
    ks: Kolmogorov-Smirnov statistic in [0, 1]. For hue it depends on where the circle is cut (at red); it is given
        because the paper gives it.
    cliffs_delta: P(second > first) - P(second < first), in [-1, 1]; not for hue, which has no order.
    wasserstein: mean shift in units of the channel's range [0, 1]; for hue on the circle, in turns.
    direction: mean direction of the second against the first in turns, in [-0.5, 0.5), for hue alone.
    """
    result = {"n_first": len(first), "n_second": len(second), **dict.fromkeys(EFFECTS, float("nan"))}
    if min(len(first), len(second)) == 0:
        return result
    result["ks"] = float(ks_2samp(first, second, method="asymp" if len(first) * len(second) > 1 else "exact").statistic)
    if channel != "hue":
        return result | {
            "cliffs_delta": cliffs_delta(first, second),
            "wasserstein": wasserstein_distance(first, second),
        }
    return result | {
        "wasserstein": circular.wasserstein(first, second),
        "direction": circular.turn(circular.mean_direction(first), circular.mean_direction(second)),
    }


def cliffs_delta(first: np.ndarray, second: np.ndarray) -> float:
    """P(second > first) - P(second < first), in [-1, 1] (Cliff 1993, "Dominance statistics").

    >>> import numpy as np
    >>> cliffs_delta(np.array([1, 2]), np.array([2, 3]))
    0.75
    """
    ordered = np.sort(first)
    below = np.searchsorted(ordered, second, side="left")
    not_above = np.searchsorted(ordered, second, side="right")
    return float((below + not_above - len(first)).mean() / len(first))


def greys(samples: pd.DataFrame) -> pd.Series:
    """Share of pixels without a hue, for each source."""
    return samples["hue"].isna().groupby(samples["source"], observed=True).mean()


def table(tests: pd.DataFrame, title: str = "Hue, saturation and value") -> Table:
    """A row per channel and pair: each effect size as mean ± standard deviation over seeds."""
    groups = tests.sort_values("channel", kind="stable").groupby(["channel", "pair"], sort=False)
    data = groups[list(EFFECTS)].agg(["mean", "std"])
    data[("seeds", "n")] = groups.size()
    text = data.index.to_frame(index=False)
    for name in EFFECTS:
        heading = name.replace("_", " ").replace("cliffs", "Cliff's")
        text[heading] = [spread(*row) for row in data[name].itertuples(index=False)]
    text["seeds"] = data[("seeds", "n")].map(str).to_numpy()
    notes = (
        "ks: Kolmogorov-Smirnov statistic; Wasserstein distance in units of the channel's range, for hue on the circle "
        "in turns; direction: mean hue of the second against the first, turns",
    )
    return Table(title, text, data, pd.DataFrame(False, index=text.index, columns=text.columns), notes)


def spread(mean: float, std: float) -> str:
    """`0.0342 ± 0.0011`; `0.0342` if the deviation is NaN, empty if the mean is."""
    if np.isnan(mean):
        return ""
    return f"{mean:.4f}" + ("" if np.isnan(std) else f" ± {std:.4f}")


DESCRIPTION = """\
Hue, saturation and value of the stored renderings against the truth and each other: effect sizes
for each channel and pair, mean over seeds. Grey pixels have no hue.
"""
EXAMPLES = """\
  {} runs --filter scene_name=poster
  {} runs --filter scene_name=poster --quantum field=qdensity,qiren=2L2S --grey 0.1
"""


def main(arguments: Sequence[str] | None = None) -> None:
    parser = command.parser("hsv", DESCRIPTION, EXAMPLES)
    command.add_runs(parser)
    command.add_format(parser)
    parser.add_argument("--classical", default="field=classical", metavar="KEY=VALUE,...", help="default: %(default)s")
    parser.add_argument("--quantum", default="field=qcolor", metavar="KEY=VALUE,...", help="default: %(default)s")
    parser.add_argument(
        "--grey", type=share, default=GREY, help="saturation of a grey pixel at most; default: %(default)s"
    )
    options = parser.parse_args(arguments)
    sources = {name: getattr(options, name) for name in ("classical", "quantum")}
    problems: list[str] = []
    made = table(tests(samples(command.chosen(options), **sources, grey=options.grey, problems=problems)))
    left_out = [f"left out: {len(problems)} views with damaged pictures, the first {problems[0]}"] if problems else []
    command.show(replace(made, notes=(*made.notes, *left_out)), options.format)


if __name__ == "__main__":
    command.run(main)
