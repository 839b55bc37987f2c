"""`qnerf.run` and its siblings: the command line without a command line."""

import base64
import sys
from concurrent.futures import ThreadPoolExecutor
from types import SimpleNamespace

import IPython.display as display
import numpy as np
import pytest
import torch

import qnerf as package
from qnerf.cli import python
from qnerf.geometry.camera_paths import Camera


def test_run_trains_and_gives_a_run_that_shows_itself(small, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(sys, "exit", pytest.fail)
    monkeypatch.setitem(sys.modules, "ipykernel", sys)  # a script that imports it is no notebook
    trained = package.run(*small)
    assert "changed" in capsys.readouterr().out
    assert trained.state == "finished"
    assert trained.summary["steps"] == 2
    assert trained.summary["psnr"] == pytest.approx(trained.eval()["psnr"].mean())
    assert {"train/loss", "train/psnr"} <= set(trained.metrics()["key"])
    assert sum(p.numel() for p in trained.model.parameters()) == trained.summary["params.total"]
    picture = trained.render(0)
    assert picture.size == tuple(trained.trained.scene.cameras.all_sizes[0].tolist())
    assert np.asarray(picture).std() > 0
    shown = trained._repr_html_()
    assert trained.id in shown
    assert "PSNR" in shown
    assert base64.b64encode(trained.pictures()[0].read_bytes()).decode() in shown
    assert package.load(trained.id[-5:], store=str(tmp_path / "runs")).path == trained.path
    assert trained.render(Camera(np.eye(4)[:3], 5.0, 6, 4)).size == (6, 4)
    assert trained.render(np.int64(0)) == picture
    for wrong in (99, -1, 0.5, "a", None):
        with pytest.raises(ValueError, match="expected the number of a view from 0"):
            trained.render(wrong)


def test_run_has_the_id_and_the_results_of_the_command(small, qnerf, tmp_path):
    trained = package.run(*small)
    done = qnerf("run", *small)
    assert done.code == 0
    assert f"{trained.id}" in done.out
    assert "finished already" in done.out or "is finished" in done.out
    assert [path.name for path in (tmp_path / "runs").glob("[!.]*")] == [trained.id]


def test_sweep_trains_every_combination_and_leaves_out_what_fails(small, tmp_path, capsys):
    trained = package.sweep(*small, "seed=0,1", "render.far=1000.0,0.01")
    shown = capsys.readouterr()
    assert "4 jobs, 4 different runs" in shown.out
    assert [run.summary["seed"] for run in trained] == [0, 1]
    assert shown.err.count("error: ") == 2
    listed = package.runs("state=finished seed=1", store=str(tmp_path / "runs"))
    assert list(listed["run_id"]) == [trained[1].id]


def test_run_and_sweep_refuse_mistakes_in_one_line(small, tmp_path):
    wrong = {
        "train.step=3": "did you mean train.steps",
        "seed=0,1": "use qnerf.sweep",
        "hydra/launcher=submitit_local": "for the command line",
    }
    for override, message in wrong.items():
        with pytest.raises(ValueError, match=message) as caught:
            package.run(*small, override)
        assert "\n" not in str(caught.value), override
    with pytest.raises(ValueError, match="needs a search"):
        package.sweep(*small, "train.lr=interval(0,1)")
    assert not (tmp_path / "runs").exists()


def test_notebook_bar_is_replaced_not_repeated(small, monkeypatch):
    shown = []

    class Handle:
        def update(self, data, raw):
            shown.append(data)

    monkeypatch.setattr(display, "display", lambda *_, **__: Handle())
    monkeypatch.setattr("IPython.get_ipython", lambda: SimpleNamespace(kernel=None))
    monkeypatch.setattr(python, "REFRESH", 0.0)
    package.run(*small)
    assert [data["text/html"].partition(">")[0] for data in shown] == [
        f'<progress value="{step}" max="2"' for step in (1, 2)
    ]


def test_run_leaves_the_callers_random_stream_and_threads(small, tmp_path):
    torch.manual_seed(5)
    before, threads = torch.random.get_rng_state(), torch.get_num_threads()
    with ThreadPoolExecutor(2) as pool:
        made = list(pool.map(lambda seed: package.run(*small, f"seed={seed}", "threads=1"), (3, 4)))
    assert [trained.state for trained in made] == ["finished", "finished"]
    assert torch.equal(before, torch.random.get_rng_state())
    assert torch.get_num_threads() == threads
