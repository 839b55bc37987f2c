"""The first channels of each encoding on a slice of the scene."""

from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from .. import style
from .probed import probed

CHANNELS = 8
NAMES = {
    "none": "none",
    "pe": "positional\nencoding",
    "rff": "random Fourier\nfeatures",
    "hash": "hash grid",
    "sh": "spherical\nharmonics",
}


def encoding_slices(run: str | Path) -> dict[tuple[str, bool], np.ndarray]:
    """(encoder, trained) -> the first eight channels (8, H, W).

    Row 0 is the lowest y. Channels that an encoder lacks are NaN.
    """
    table = probed(run, "encoding")
    slices = {}
    for (name, trained), rows in table.groupby(["encoder", "trained"], sort=False):
        height, width = rows["row"].max() + 1, rows["column"].max() + 1
        values = rows.sort_values(["row", "column"])[[f"channel_{index}" for index in range(CHANNELS)]].to_numpy()
        slices[str(name), bool(trained)] = values.T.reshape(CHANNELS, height, width)
    return dict(sorted(slices.items(), key=lambda item: list(NAMES).index(item[0][0])))


@style.styled
def encoding_channels(run: str | Path) -> Figure:
    """The first eight channels of a run's encoder and of the others on the plane z = 0, a row per encoder."""
    slices = encoding_slices(run)
    figure = style.new(style.PAGE, 0.5 + 0.78 * len(slices))
    axes = figure.subplots(len(slices), CHANNELS, squeeze=False)
    for row, ((name, trained), channels) in zip(axes, slices.items(), strict=True):
        limit = np.nanquantile(np.abs(channels), 0.99)
        for ax, channel in zip(row, channels, strict=True):
            if np.isnan(channel).all():
                ax.set_axis_off()
                continue
            ax.imshow(channel, origin="lower", cmap="PuOr", vmin=-limit, vmax=limit)
            ax.set(xticks=[], yticks=[])
            ax.grid(False)
        state = "trained" if trained else "untrained" if name == "hash" else ""
        text = "\n".join(filter(None, [NAMES[name], state, f"± {limit:.2g}"]))
        row[0].set_ylabel(text, rotation=0, ha="right", va="center")
    for index, ax in enumerate(axes[0]):
        ax.set_title(str(index))
    style.footnote(
        figure,
        "plane z = 0 of contracted space; purple positive, orange negative, up to the ± under each name",
        "spherical harmonics: all directions, longitude to the right, cosine of the polar angle upwards",
        Path(run).name,
    )
    return figure
