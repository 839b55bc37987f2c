"""examples/ does what it says: each script, with few steps."""

import runpy

from qnerf import records
from tests.helpers.configs import MOMENT, ROOT, TINY
from tests.helpers.processes import call

SMALL = (*(option for option in MOMENT if not option.startswith("train.steps")), *TINY, "scene.views=6", "threads=1")


def example(name):
    """The names that a script defines."""
    return runpy.run_path(str(ROOT / "examples" / f"{name}.py"))


def test_field_gives_a_verdict_and_a_picture(tmp_path, capsys):
    example("field")["main"](2, 2, tmp_path, *SMALL)
    said = capsys.readouterr().out
    assert "qcolor - classical: " in said
    assert "| poster | qcolor |" in said
    assert (tmp_path / "view.png").is_file()


def test_layer_fits_two_frequencies_with_two_uploads():
    errors = example("layer")["main"](200)
    assert errors[2] < 1e-4 < 1e-2 < errors[1]


def test_own_head_is_trained_under_its_name_and_options(tmp_path):
    words = ("plugins=[own_head]", "color=products", "density=mlp", "color.products.rank=8", "train.steps=2")
    trained = call("run", *words, *SMALL, f"store={tmp_path}", cwd=ROOT / "examples")
    assert trained.returncode == 0, trained.stderr
    (run,) = records.runs(tmp_path)
    summary = records.read_summary(run)
    assert (summary["color"], summary["color.products.rank"]) == ("products8x2", 8)
