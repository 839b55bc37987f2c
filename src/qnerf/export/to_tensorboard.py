"""TensorBoard: one event file per run under `<out>/<run_id>/`."""

import contextlib
import json
import textwrap
from pathlib import Path

from torch.utils.tensorboard import SummaryWriter
from torch.utils.tensorboard.summary import hparams

from qnerf.config.checks import is_number
from qnerf.export.content import Content, make_folder
from qnerf.records import StoreError
from qnerf.records.pictures import read_png

SUFFIX = ".qnerf"


def export(content: Content, out: Path) -> Path:
    """Returns the run's folder under `out`: scalars with step and wall time, images, hyperparameters, tags and note.

    The new event file replaces the one of an earlier export; other files stay.
    """
    run = content.run
    folder = make_folder(out, run.path)
    for earlier in folder.glob(f"events.out.tfevents.*{SUFFIX}"):
        earlier.unlink()
    with SummaryWriter(str(folder), filename_suffix=SUFFIX) as writer:
        settings = {name: "none" if value is None else value for name, value in run.flat.items()}
        numbers = {f"final/{name}": value for name, value in content.results.items() if is_number(value)}
        for summary in hparams(settings, numbers):
            writer._get_file_writer().add_summary(summary)
        texts = {
            "state": run.state,
            "tags": ", ".join(run.annotations.tags),
            "note": run.annotations.note,
            "results": json.dumps(content.results, indent=1, default=str),
        }
        for name, text in texts.items():
            # Markdown shows indented text literally: no links and no pictures out of a note.
            writer.add_text(name, textwrap.indent(text, "    ", lambda line: True), walltime=content.created)
        for step, time_s, key, value in content.metrics.itertuples(index=False, name=None):
            writer.add_scalar(key, value, step, walltime=content.created + time_s)
        for name, value in numbers.items():
            writer.add_scalar(name, value, content.step, walltime=content.ended)
        for path in content.images:
            with contextlib.suppress(StoreError):  # damaged
                picture = read_png(path)
                writer.add_image(f"images/{path.stem}", picture, content.step, content.ended, dataformats="HWC")
    return folder
