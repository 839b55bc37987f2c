"""The colours of renderings against the truth: distributions of hue, saturation and value, tests and effect sizes."""

from collections.abc import Mapping, Sequence
from itertools import combinations

import numpy as np
import pandas as pd
from matplotlib.colors import rgb_to_hsv
from scipy.stats import ks_2samp, wasserstein_distance

from qnerf.records.filters import require

from . import circular, command
from .images import panels, pictures
from .selection import refuse_mixtures, refuse_scenes, select
from .tables.table import Table

SOURCES = ("truth", "classical", "quantum")
CHANNELS = ("hue", "saturation", "value")
GREY = 0.05
"""Saturation up to which a pixel counts as grey: it has no hue."""

CLASSICAL = {"field": "classical"}
QUANTUM = {"field": "qcolor"}


def samples(
    frame: pd.DataFrame,
    *,
    classical: str | Mapping[str, object] = CLASSICAL,
    quantum: str | Mapping[str, object] = QUANTUM,
    grey: float = GREY,
) -> pd.DataFrame:
    """One row a pixel of the held-out views that all chosen runs have pictures of.

    Columns source (truth | classical | quantum), seed (of the run; missing for the truth, which is there once), image,
    and hue, saturation, value in [0, 1], hue in turns and NaN for a grey pixel, one of saturation <= `grey`.

    classical, quantum: conditions that choose the runs of `frame`; see `qnerf.records.filters`. ValueError where they
    choose none, several scenes or configurations, or runs that have no view in common.
    """
    finished = select(frame).runs
    chosen = {"classical": require(finished, classical), "quantum": require(finished, quantum)}
    for source, runs in chosen.items():
        refuse_mixtures(runs.assign(source=source), ["source"])
    both = pd.concat(chosen.values())
    refuse_scenes(both, [])
    stored = {path: pictures(path) for path in both["path"]}
    common = sorted(set.intersection(*(set(names) for names in stored.values())))
    if not common:
        without = sum(not names for names in stored.values())
        raise ValueError(f"no picture that all {len(both)} runs have; {without} of them have none at all")
    pieces = []
    for image in common:
        for source, runs in chosen.items():
            for path, seed in zip(runs["path"], runs["seed"], strict=True):
                strip = panels(stored[path][image])
                pieces.append(pixels(strip.render, grey).assign(source=source, seed=seed, image=image))
        pieces.append(pixels(strip.truth, grey).assign(source="truth", seed=None, image=image))
    table = pd.concat([piece.astype({"seed": "Int64"}) for piece in pieces], ignore_index=True)
    return table.astype({"source": pd.CategoricalDtype(SOURCES), "image": "category"})[
        ["source", "seed", "image", *CHANNELS]
    ]


def pixels(image: np.ndarray, grey: float = GREY) -> pd.DataFrame:
    """Hue (turns), saturation and value in [0, 1] of an image (H, W, 3) uint8, a row a pixel; a grey one has no hue."""
    table = pd.DataFrame(rgb_to_hsv(image.reshape(-1, 3) / 255), columns=list(CHANNELS))
    table.loc[table["saturation"] <= grey, "hue"] = np.nan
    return table


def tests(samples: pd.DataFrame) -> pd.DataFrame:
    """Each channel compared between each two sources, a row a seed that both have; the truth goes with every seed.

    Columns channel, pair, seed, and the pixels n_first, n_second that have the channel;
    ks, ks_p: two-sample Kolmogorov-Smirnov statistic, itself an effect size in [0, 1], and its p-value. For hue it
        depends on the circle being cut at red; the paper gives it nevertheless.
    kuiper, kuiper_p: for hue alone, `circular.kuiper`, the same on the circle.
    cliffs_delta: P(second > first) - P(second < first), in [-1, 1]; not for hue, which has no order.
    wasserstein: mean shift in units of the channel's range [0, 1]; for hue on the circle, in turns.
    direction: for hue alone, mean direction of the second against the first, turns in [-0.5, 0.5).
    All NaN where a source has no pixel with the channel. Pixels are no independent draws and there are many of them:
    p-values are tiny whatever the effect, so judge by the effect sizes.
    """
    of = dict(list(samples.groupby(["source", samples["seed"].fillna(-1)], observed=True)))
    lines = []
    for first, second in combinations(SOURCES, 2):
        seeds = sorted({seed for source, seed in of if source == second})
        for seed in seeds:
            one = of.get((first, -1 if first == "truth" else seed))
            if one is None:
                continue
            for channel in CHANNELS:
                a, b = (part[channel].dropna().to_numpy() for part in (one, of[second, seed]))
                lines.append({"channel": channel, "pair": f"{first} - {second}", "seed": seed} | compare(a, b, channel))
    return pd.DataFrame(lines)


def compare(first: np.ndarray, second: np.ndarray, channel: str) -> dict[str, float]:
    """The statistics of `tests` for two arrays of a channel."""
    names = ("ks", "ks_p", "kuiper", "kuiper_p", "cliffs_delta", "wasserstein", "direction")
    line = {"n_first": len(first), "n_second": len(second), **dict.fromkeys(names, float("nan"))}
    if min(len(first), len(second)) == 0:
        return line
    found = ks_2samp(first, second, method="asymp" if len(first) * len(second) > 1 else "exact")
    line |= {"ks": float(found.statistic), "ks_p": float(found.pvalue)}
    if channel != "hue":
        return line | {"cliffs_delta": cliffs_delta(first, second), "wasserstein": wasserstein_distance(first, second)}
    statistic, p = circular.kuiper(first, second)
    direction = circular.turn(circular.mean_direction(first), circular.mean_direction(second))
    return line | {
        "kuiper": statistic,
        "kuiper_p": p,
        "wasserstein": circular.wasserstein(first, second),
        "direction": direction,
    }


def cliffs_delta(first: np.ndarray, second: np.ndarray) -> float:
    """P(second > first) - P(second < first), in [-1, 1] (Cliff 1993, "Dominance statistics")."""
    ordered = np.sort(first)
    below = np.searchsorted(ordered, second, side="left")
    not_above = np.searchsorted(ordered, second, side="right")
    return float((below + not_above - len(first)).mean() / len(first))


def greys(samples: pd.DataFrame) -> pd.Series:
    """Share of pixels without a hue, for each source."""
    return samples["hue"].isna().groupby(samples["source"], observed=True).mean()


def table(tests: pd.DataFrame, title: str = "Hue, saturation and value") -> Table:
    """Mean over seeds of the statistics of `tests`, a row each channel and pair; ± standard deviation, largest p."""
    groups = tests.sort_values("channel", kind="stable").groupby(["channel", "pair"], sort=False)
    effects = ["ks", "kuiper", "cliffs_delta", "wasserstein", "direction"]
    data = groups[effects].agg(["mean", "std"])
    data[("ks_p", "max")], data[("kuiper_p", "max")] = groups["ks_p"].max(), groups["kuiper_p"].max()
    data[("seeds", "n")] = groups.size()
    text = data.index.to_frame(index=False)
    for name in effects:
        text[name.replace("_", " ").replace("cliffs", "Cliff's")] = [
            spread(*row) for row in data[name].itertuples(index=False)
        ]
    circled = data[("kuiper_p", "max")].notna()
    text["p"] = [_p(p) for p in data[("kuiper_p", "max")].where(circled, data[("ks_p", "max")])]
    text["seeds"] = data[("seeds", "n")].map(str).to_numpy()
    notes = (
        "ks: Kolmogorov-Smirnov statistic; kuiper: its circular form, for hue; Wasserstein distance in units of the "
        "channel's range, for hue on the circle in turns; direction: mean hue of the second against the first, turns",
        "p: the largest over the seeds, Kuiper's for hue; pixels are not independent and many, so it is tiny whatever "
        "the effect",
    )
    return Table(title, text, data, pd.DataFrame(False, index=text.index, columns=text.columns), notes)


def spread(mean: float, std: float) -> str:
    """`0.0342 ± 0.0011`; no spread where the deviation is NaN, nothing where the mean is."""
    if np.isnan(mean):
        return ""
    return f"{mean:.4f}" + ("" if np.isnan(std) else f" ± {std:.4f}")


def _p(p: float) -> str:
    return "" if np.isnan(p) else f"{p:.1e}" if p > 0 else "< 1e-300"


DESCRIPTION = """\
Hue, saturation and value of the stored renderings against the truth and each other: Kolmogorov-Smirnov and Kuiper
tests and effect sizes for each channel and pair, mean over seeds. Grey pixels have no hue.
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
        "--grey", type=float, default=GREY, help="saturation of a grey pixel at most; default: %(default)s"
    )
    options = parser.parse_args(arguments)
    sources = {name: getattr(options, name) for name in ("classical", "quantum")}
    command.show(table(tests(samples(command.chosen(options), **sources, grey=options.grey))), options.format)


if __name__ == "__main__":
    command.run(main)
