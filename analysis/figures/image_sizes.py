"""What larger images cost, and what they score."""

from matplotlib.figure import Figure

from qnerf.metrics import metric_of

from .. import style
from . import benchmarks

SHOWN = {"psnr": metric_of("eval/psnr").heading, "cpu_s": "training, CPU s", "peak_mb": "peak memory, MB"}


@style.styled
def image_sizes(results: benchmarks.Results = None) -> Figure:
    """Held-out PSNR, seconds of training and peak memory against the images' longer side, with `train=large`.

    Its own number of steps, means over seeds.
    """
    rows = benchmarks.read("image_sizes", results)
    rows = rows[(rows["recipe"] == "large") & (rows["steps_given"] == 0) & (rows["extra"] == "")]
    means = rows.groupby(["scene", "size"])[list(SHOWN)].mean().reset_index()
    figure = style.new(style.PAGE, 2.6)
    for ax, (column, label) in zip(figure.subplots(1, len(SHOWN)), SHOWN.items(), strict=True):
        for number, (scene, part) in enumerate(means.groupby("scene")):
            ax.plot(part["size"], part[column], label=scene, **style.series(number))
        ax.set(xscale="log", xlabel="longer side, pixels", ylabel=label)
        ax.set_xticks(sorted(set(means["size"])), labels=sorted(set(means["size"])))
        ax.minorticks_off()
        if column != "psnr":
            ax.set_ylim(0, 1.1 * means[column].max())
    style.legend(figure)
    return figure
