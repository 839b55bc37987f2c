"""Trainings that are stopped at a step."""

import pytest

from qnerf import experiment, records


class At(experiment.Display):
    """Calls `action` after a step."""

    def __init__(self, step, action):
        self.when, self.action = step, action

    def step(self, step, metrics):
        if step == self.when:
            self.action()


class StopsWhen(experiment.Display):
    """Stops once `condition` is true."""

    def __init__(self, condition):
        self.condition = condition

    def stopping(self):
        return self.condition()


def interrupted(config, step, error=None):
    """The run of a training that ends by an error, default: Ctrl-C, after this step and before it is saved."""
    error = error or KeyboardInterrupt()

    def fail():
        raise error

    with pytest.raises(type(error)):
        experiment.run(config, display=At(step, fail))
    (run,) = records.runs(config["store"])
    return run
