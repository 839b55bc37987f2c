"""Waves of known frequencies."""

from types import SimpleNamespace

import pytest

from qnerf.signals import Tones
from qnerf.training.image_metrics import octave_energies


def halved(tones):
    """A fit that returns half of the truth."""
    return SimpleNamespace(values=lambda points: tones.truth.flatten(0, -2) / 2)


@pytest.mark.parametrize("dims", [1, 2])
def test_each_octave_has_the_same_energy(dims):
    tones = Tones(dims=dims, octaves=4, size=64)
    assert octave_energies(tones.truth) == pytest.approx([0, *[64**dims / 4] * 4, 0], abs=1e-9)
    measured, panels = tones.evaluate(halved(tones))
    assert measured == pytest.approx(
        {"explained": 0.75, **{f"error_octave_{number}": 0.25 for number in (1, 2, 3, 4)}, "error_octave_5": None}
    )
    assert [panel.shape for panel in panels] == [(64, 64, 3)] * 3
    assert not tones.truth.equal(Tones(dims=dims, octaves=4, size=64, seed=1).truth)


def test_a_test_s_points_are_in_no_octave_while_others_validate():
    tones = Tones(octaves=2, size=16, held_out=0.25)
    assert (len(tones.points), len(tones.unseen)) == (12, 4)
    assert "error_octave_1" in tones.evaluate(halved(tones))[0]
    validating = tones.validating(0.5)
    assert list(validating.evaluate(halved(tones))[0]) == ["explained"]
    assert not validating.truth.flatten(0, -2)[tones.unseen].any()


def test_too_few_points_for_the_octaves_are_one_line():
    with pytest.raises(ValueError, match=r"^scene.size=64: expected at least 128 points a side for scene.octaves=6$"):
        Tones(size=64)
