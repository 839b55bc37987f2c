"""MLflow: a run becomes an MLflow run, which is found again by its tags `qnerf.run_id` and `qnerf.created`."""

import logging
import os
from collections.abc import Iterator, Sequence
from typing import Any

# An unreachable server is reported within seconds instead of minutes, unless the user set another number.
os.environ.setdefault("MLFLOW_HTTP_REQUEST_MAX_RETRIES", "2")

from mlflow import MlflowClient
from mlflow.entities import Metric, Param, RunTag
from mlflow.entities import Run as MlflowRun
from mlflow.exceptions import MlflowException

from qnerf.config.checks import is_number
from qnerf.export.content import Content
from qnerf.records.files import one_line

METRICS, PARAMS = 1000, 100
"""The most metrics and parameters in one request."""

TEXT = 5000
"""The most characters in the value of a tag or parameter; servers limit them."""

COPIED = "qnerf.copied"
"""Tag with the state and step of a complete copy. It is set last: after a kill the server is asked what it has."""

_STATUS = {"finished": "FINISHED", "failed": "FAILED", "interrupted": "KILLED"}


def export(content: Content, uri: str | None = None, experiment: str = "qnerf") -> str:
    """Creates the MLflow run or updates it; only missing rows are sent. Returns its MLflow id.

    uri: of a tracking server or database, by default MLflow's own choice. A run that was started again with
    `run.force=true` is another MLflow run.

    Raises:
        ValueError: the server refuses or cannot be reached.
    """
    for name in ("alembic", "mlflow.store", "mlflow.tracking"):  # they announce every table that they create
        logging.getLogger(name).setLevel(logging.WARNING)
    try:
        client = MlflowClient(tracking_uri=uri)
        run = _find_or_create(client, _experiment(client, experiment), content)
        _log(client, run, content)
    except MlflowException as error:
        raise ValueError(f"MLflow: {one_line(error)}") from error
    return str(run.info.run_id)


def _experiment(client: MlflowClient, name: str) -> str:
    existing = client.get_experiment_by_name(name)
    return str(existing.experiment_id if existing else client.create_experiment(name))


def _find_or_create(client: MlflowClient, experiment: str, content: Content) -> MlflowRun:
    tags = {"qnerf.run_id": content.run_id, "qnerf.created": repr(content.created)}
    query = " and ".join(f"tags.`{key}` = '{value}'" for key, value in tags.items())
    if runs := client.search_runs([experiment], query, max_results=1):
        return runs[0]
    start = round(content.created * 1000)
    return client.create_run(experiment, start_time=start, tags=tags, run_name=content.run_id)


def _log(client: MlflowClient, run: MlflowRun, content: Content) -> None:
    run_id = run.info.run_id
    client.log_batch(run_id, tags=[RunTag(name, text[:TEXT]) for name, text in _tags(content).items()])
    progress = f"{content.state} at step {content.step}"
    if run.data.tags.get(COPIED) == progress:
        return
    missing = {name: value for name, value in content.config.items() if name not in run.data.params}
    params = [Param(name, str(value)[:TEXT]) for name, value in missing.items()]
    for batch in _batches(params, PARAMS):
        client.log_batch(run_id, params=batch)
    last = {key: max(m.step for m in client.get_metric_history(run_id, key)) for key in run.data.metrics}
    for batch in _batches(list(_metrics(content, last)), METRICS):
        client.log_batch(run_id, metrics=batch)
    for path in content.files:
        client.log_artifact(run_id, str(path))
    for path in content.images:
        client.log_artifact(run_id, str(path), "images")
    if content.state == "running":
        client.update_run(run_id, status="RUNNING")
    else:
        client.set_terminated(run_id, _STATUS.get(content.state, "FAILED"), round(content.ended * 1000))
    client.set_tag(run_id, COPIED, progress)


def _metrics(content: Content, last: dict[str, int]) -> Iterator[Metric]:
    """The rows of each key after its last step on the server, then the results as `final/...` at the last step."""
    last_steps = content.metrics["key"].map(last)
    rows = content.metrics[~(content.metrics["step"] <= last_steps)]
    for step, time_s, key, value in rows.itertuples(index=False, name=None):
        yield Metric(key, value, round((content.created + time_s) * 1000), step)
    for name, value in content.results.items():
        key = f"final/{name}"
        if is_number(value) and last.get(key, -1) < content.step:
            yield Metric(key, float(value), round(content.ended * 1000), content.step)


def _tags(content: Content) -> dict[str, str]:
    texts = {name: value for name, value in content.results.items() if isinstance(value, str)}
    return {
        **{f"qnerf.{name}": value for name, value in texts.items()},
        "qnerf.state": content.state,
        "qnerf.tags": ",".join(content.annotations.tags),
        "mlflow.note.content": content.annotations.note,
        **({"mlflow.source.git.commit": content.commit} if content.commit else {}),
    }


def _batches(items: Sequence[Any], size: int) -> Iterator[Sequence[Any]]:
    for start in range(0, len(items), size):
        yield items[start : start + size]
