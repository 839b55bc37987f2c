import pytest

from qnerf.building.configuration import Configuration
from qnerf.config.settings import Schedule
from qnerf.training.schedules import SCHEDULES, falls_from, learning_rate
from tests.helpers.trainer import trainer


def schedule(**options):
    return Schedule(**{"rates": None, "steps": 200, "lr": 0.5, "lr_final": 0.125, "eps": 1e-15, **options})


def test_a_schedule_by_default_is_the_published_exponential():
    """To the last bit: ids of before stand for the same numbers."""
    train = schedule(steps=3000, lr=1e-2, lr_final=1e-4)
    assert all(learning_rate(step, train) == 1e-2 * (1e-4 / 1e-2) ** (step / 3000) for step in range(3001))


@pytest.mark.parametrize(("name", "halfway"), [("exponential", 0.25), ("linear", 0.3125), ("cosine", 0.3125)])
@pytest.mark.parametrize(("cooldown", "start"), [(1.0, 0), (0.3, 140)])
def test_a_schedule_stays_and_then_falls(name, halfway, cooldown, start):
    train = schedule(schedule=name, cooldown=cooldown)
    assert falls_from(train) == start
    rates = [learning_rate(step, train) for step in range(201)]
    assert set(rates[: start + 1]) == {0.5}
    assert all(later < earlier for earlier, later in zip(rates[start:], rates[start + 1 :], strict=False))
    assert (rates[(start + 200) // 2], rates[-1]) == pytest.approx((halfway, 0.125))


def test_a_schedule_warms_up_and_scales_with_the_steps():
    train = schedule(schedule="linear", warmup=0.05, cooldown=0.5)
    assert [learning_rate(step, train) for step in (0, 4, 9, 10, 100)] == pytest.approx([0.05, 0.25, 0.5, 0.5, 0.5])
    assert learning_rate(150, train) == learning_rate(1500, schedule(schedule="linear", steps=2000, cooldown=0.5))


def test_a_schedule_that_falls_to_nothing_is_no_exponential():
    assert learning_rate(200, schedule(schedule="cosine", lr_final=0.0)) == 0
    with pytest.raises(ValueError, match=r"train\.lr_final=0 needs train\.schedule=linear or cosine"):
        learning_rate(0, schedule(lr_final=0.0))


def test_a_schedule_of_ones_own_sets_the_rates_of_a_training(tiny, monkeypatch):
    monkeypatch.setitem(SCHEDULES._components, "halved", lambda first, last, fallen: first / 2)
    taken = trainer(tiny("train.schedule=halved", "train.lr=0.5", "train.rates.color=0.5"))
    rates = {group["name"]: group["lr"] for group in taken.optimiser.param_groups}
    assert (rates["density"], rates["color"]) == (0.25, 0.125)
    with pytest.raises(ValueError, match=r"train\.schedule: unknown name 'third'; known: .*halved, linear"):
        trainer(tiny("train.schedule=third"))


def test_the_quick_recipe_falls_to_nothing_by_the_same_rule_at_any_number_of_steps(config):
    for name in ("quick", "large"):
        for budget in ("smoke", "short", "paper"):
            train = Configuration.of(config(f"train={name}", f"budget={budget}")).settings.train
            assert (train.schedule, train.cooldown, train.lr_final) == ("linear", 0.3, 0.0)
