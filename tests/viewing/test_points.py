"""`qnerf export`: points of a ball of known size, the files, the coordinates."""

import io

import numpy as np
import pytest
import torch
import trimesh

from qnerf.cli import main
from qnerf.viewing import ply, points
from qnerf.viewing.frames import Renderer


def test_points_lie_where_rays_end_with_normals_towards_the_cameras(ball):
    hits = points.ray_ends(ball, 10_000)
    assert not len(points.ray_ends(ball, 10).points) > 10
    cloud = points.cloud(hits)
    assert 0 < len(cloud.points) <= len(hits.points)
    np.testing.assert_allclose(np.linalg.norm(cloud.normals, axis=1), 1)
    with pytest.raises(ValueError, match=r"no ray of a training view ends within 0\.001"):
        points.ray_ends(ball, 100, within=0.001)


def test_normals_of_points_on_a_ball_are_its_radii():
    ends = torch.randn(2000, 3, generator=torch.Generator().manual_seed(0))
    ends = ends / ends.norm(dim=1, keepdim=True)
    far = torch.tensor([[9.0, 9, 9]])
    hits = points.Hits(torch.cat([ends, far]), -torch.cat([ends, far]), torch.zeros(2001, 3))
    cloud = points.cloud(hits)
    assert len(cloud.points) == 2000, "the isolated point is dropped"
    assert (cloud.normals * cloud.points).sum(1).min() > 0.95


def read(content):
    """A PLY file as trimesh reads it."""
    return trimesh.load(io.BytesIO(content), file_type="ply", process=False)


def test_a_ply_file_is_what_others_read():
    random = np.random.default_rng(0)
    normals = random.normal(size=(5, 3)).astype(np.float32)
    own = ply.Points(normals + 1, normals, random.integers(0, 256, (5, 3), np.uint8))
    theirs = read(ply.encode(own))
    np.testing.assert_array_equal(theirs.vertices.astype(np.float32), own.points)
    np.testing.assert_array_equal(theirs.colors[:, :3], own.colors)
    data = theirs.metadata["_ply_raw"]["vertex"]["data"]
    np.testing.assert_array_equal(np.stack([data[name] for name in ("nx", "ny", "nz")], axis=1), normals)


def test_export_writes_points_in_the_coordinates_of_transforms_json(tiny_run, trained, tmp_path, capsys):
    out = tmp_path / "out"
    assert main.dispatch("export", [str(tiny_run), "--within", "900", "--out", str(out)]) == 0
    assert "step 3, " in capsys.readouterr().out
    content = (out / f"{tiny_run.name}.ply").read_bytes()
    file = tmp_path / "one.ply"
    assert main.dispatch("export", [str(tiny_run), "--within", "900", "--out", str(file)]) == 0
    assert file.read_bytes() == content
    assert main.dispatch("export", [*[str(tiny_run)] * 2, "--out", str(file)]) == 2
    assert "expected a folder for 2 runs" in capsys.readouterr().err
    assert main.dispatch("export", [str(tiny_run), "--out", str(tmp_path / "x.OBJ")]) == 2
    assert "expected a folder or NAME.ply" in capsys.readouterr().err
    assert main.dispatch("export", [str(tiny_run), "--within", "0.001", "--out", str(out)]) == 2
    assert f"error: {tiny_run.name}: no ray" in capsys.readouterr().err
    written = np.asarray(read(content).vertices)
    mine = points.cloud(points.ray_ends(Renderer(trained), 10**6, 900))
    homogeneous = np.concatenate([written, np.ones((len(written), 1))], axis=1)
    np.testing.assert_allclose(
        homogeneous @ trained.scene.transform.numpy().T[:, :3], mine.points, rtol=1e-4, atol=1e-4
    )
