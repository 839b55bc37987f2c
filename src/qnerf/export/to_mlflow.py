"""MLflow: a run becomes an MLflow run, which is found again by its tags `qnerf.run_id` and `qnerf.created`."""

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

METRICS, PARAMS = 1000, 100  # the most in one request
TEXT = 5000  # the most characters in the value of a tag or parameter; servers limit them
_STATUS = {"running": "RUNNING", "finished": "FINISHED", "interrupted": "KILLED"}


def export(content: Content, uri: str | None = None, experiment: str = "qnerf") -> str:
    """Creates the MLflow run or updates it; only missing rows are sent. Returns its MLflow id.

    uri: of a tracking server or database, by default MLflow's own choice. A run that was started again with
    `run.force=true` is another MLflow run.

    Raises:
        ValueError: the server refuses or cannot be reached.
    """
    try:
        client = MlflowClient(tracking_uri=uri)
        run = _find_or_create(client, experiment, content)
        _log(client, run, content)
    except MlflowException as error:
        raise ValueError(f"MLflow: {one_line(error)}") from error
    return str(run.info.run_id)


def _find_or_create(client: MlflowClient, experiment: str, content: Content) -> MlflowRun:
    existing = client.get_experiment_by_name(experiment)
    place = existing.experiment_id if existing else client.create_experiment(experiment)
    tags = {"qnerf.run_id": content.run.run_id, "qnerf.created": repr(content.created)}
    query = " and ".join(f"tags.`{key}` = '{value}'" for key, value in tags.items())
    if runs := client.search_runs([place], query, max_results=1):
        return runs[0]
    return client.create_run(place, start_time=round(content.created * 1000), tags=tags, run_name=content.run.run_id)


def _log(client: MlflowClient, run: MlflowRun, content: Content) -> None:
    run_id, labels = run.info.run_id, content.run.annotations
    tags = {f"qnerf.{name}": value for name, value in content.results.items() if isinstance(value, str)}
    tags |= {"qnerf.state": content.run.state, "qnerf.tags": ",".join(labels.tags), "mlflow.note.content": labels.note}
    client.log_batch(run_id, tags=[RunTag(name, text[:TEXT]) for name, text in tags.items()])
    params = {name: value for name, value in content.run.flat.items() if name not in run.data.params}
    for batch in _batches([Param(name, str(value)[:TEXT]) for name, value in params.items()], PARAMS):
        client.log_batch(run_id, params=batch)
    last = {key: max(m.step for m in client.get_metric_history(run_id, key)) for key in run.data.metrics}
    for batch in _batches(list(_metrics(content, last)), METRICS):
        client.log_batch(run_id, metrics=batch)
    for folder, paths in (None, content.files), ("images", content.images):
        for path in paths:
            client.log_artifact(run_id, str(path), folder)
    status = _STATUS.get(content.run.state, "FAILED")
    if status == "RUNNING":
        client.update_run(run_id, status=status)
    else:
        client.set_terminated(run_id, status, round(content.ended * 1000))


def _metrics(content: Content, last: dict[str, int]) -> Iterator[Metric]:
    """The rows of each key after its last step on the server, then the results as `final/...` at the last step."""
    for step, time_s, key, value in content.metrics.itertuples(index=False, name=None):
        if step > last.get(key, -1):
            yield Metric(key, value, round((content.created + time_s) * 1000), step)
    for name, value in content.results.items():
        if is_number(value) and last.get(f"final/{name}", -1) < content.step:
            yield Metric(f"final/{name}", float(value), round(content.ended * 1000), content.step)


def _batches(items: Sequence[Any], size: int) -> Iterator[Sequence[Any]]:
    for start in range(0, len(items), size):
        yield items[start : start + size]
