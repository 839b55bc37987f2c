"""TensorBoard: one event file per run under `<out>/<run_id>/`, by TensorBoard's own writer, without TensorFlow.

PyTorch's SummaryWriter would decode and re-encode every image, rename the texts, and put hyperparameters into a run of
their own.
"""

import contextlib
import json
import shutil
import tempfile
import textwrap
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from tensorboard.compat.proto import event_pb2, summary_pb2
from tensorboard.plugins.hparams import api_pb2, metadata, plugin_data_pb2, summary_v2
from tensorboard.plugins.text.summary_v2 import text_pb
from tensorboard.summary.writer.event_file_writer import EventFileWriter

from qnerf.export.content import Content, make_folder
from qnerf.records.files import StoreError, reporting
from qnerf.records.pictures import read_png_bytes

SUFFIX = ".qnerf"
_STATUS = {"finished": api_pb2.STATUS_SUCCESS, "failed": api_pb2.STATUS_FAILURE, "running": api_pb2.STATUS_RUNNING}


def export(content: Content, out: Path) -> Path:
    """Returns the run's folder under `out`: scalars with step and wall time, images, hyperparameters, tags and note.

    The new event file replaces the one of an earlier export; other files stay.
    """
    folder = make_folder(out, content.run_id)
    with reporting(folder):
        before = list(folder.glob(f"events.out.tfevents.*{SUFFIX}"))
        scratch = Path(tempfile.mkdtemp(prefix=".", dir=folder))
        try:
            writer = EventFileWriter(str(scratch), filename_suffix=SUFFIX)
            with contextlib.closing(writer):
                for event in events(content):
                    writer.add_event(event)
            (written,) = scratch.iterdir()
            written.replace(folder / written.name)
        finally:
            shutil.rmtree(scratch)
        for path in before:
            path.unlink()
    return folder


def events(content: Content) -> Iterator[event_pb2.Event]:
    """All events of the run, in the order of time."""
    yield _event(content.created, 0, _hyperparameters(content))
    for name, text in _texts(content).items():
        # Markdown shows indented text literally: no links and no pictures out of a note.
        yield _event(content.created, 0, text_pb(name, textwrap.indent(text, "    ", lambda line: True)))
    for step, time_s, key, value in content.metrics.itertuples(index=False, name=None):
        scalar = summary_pb2.Summary.Value(tag=key, simple_value=value)
        yield _event(content.created + time_s, step, summary_pb2.Summary(value=[scalar]))
    for path in content.images:
        with contextlib.suppress(StoreError):  # damaged
            yield _event(content.ended, content.step, _image(f"images/{path.stem}", path))
    yield _event(content.ended, content.step, _session_end(content))


def _event(wall_time: float, step: int, summary: Any) -> event_pb2.Event:
    return event_pb2.Event(wall_time=wall_time, step=step, summary=summary)


def _hyperparameters(content: Content) -> Any:
    values = {name: _hyperparameter(value) for name, value in content.config.items()}
    return summary_v2.hparams_pb(values, trial_id=content.run_id, start_time_secs=content.created)


def _hyperparameter(value: Any) -> bool | float | str:
    """The value as TensorBoard takes it, numbers as floats."""
    if isinstance(value, int) and abs(value) >= 2**1023:  # of a damaged configuration
        return f"an integer of {value.bit_length()} bits"
    return value if isinstance(value, (bool, int, float, str)) else "none"


def _session_end(content: Content) -> Any:
    status = _STATUS.get(content.state, api_pb2.STATUS_UNKNOWN)
    end = plugin_data_pb2.SessionEndInfo(status=status, end_time_secs=content.ended)
    data = plugin_data_pb2.HParamsPluginData(session_end_info=end)
    mark = metadata.create_summary_metadata(data)
    value = summary_pb2.Summary.Value(tag=metadata.SESSION_END_INFO_TAG, metadata=mark, tensor=metadata.NULL_TENSOR)
    return summary_pb2.Summary(value=[value])


def _texts(content: Content) -> dict[str, str]:
    texts = {
        "state": content.state,
        "tags": ", ".join(content.annotations.tags),
        "note": content.annotations.note,
        "results": json.dumps(content.results, indent=1),
    }
    return {name: text for name, text in texts.items() if text}


def _image(tag: str, path: Path) -> Any:
    """The PNG as it is, without decoding it; StoreError for anything else."""
    data, width, height = read_png_bytes(path)
    image = summary_pb2.Summary.Image(width=width, height=height, colorspace=3, encoded_image_string=data)
    return summary_pb2.Summary(value=[summary_pb2.Summary.Value(tag=tag, image=image)])
