"""`qnerf export --to points|mesh`: a ball of known size, the files, the coordinates."""

import dataclasses
import io

import numpy as np
import pytest
import torch

from qnerf.cli import main
from qnerf.viewing import ply, surfaces
from qnerf.viewing.frames import Renderer
from tests.viewing.conftest import CENTRE, RADIUS


def test_the_mesh_of_a_ball_is_that_ball(ball):
    hits = surfaces.ray_ends(ball, 10_000)
    mesh = surfaces.mesh(ball, hits, cells=40, level=2000.0)
    out = mesh.points - CENTRE.numpy()
    np.testing.assert_allclose(np.linalg.norm(out, axis=1), RADIUS, atol=0.005)
    facing = (mesh.normals * out / RADIUS).sum(1)
    assert facing.mean() > 0.98, "normals point into empty space"
    corners = mesh.points[mesh.faces]
    turned = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    assert ((turned * (corners.mean(1) - CENTRE.numpy())).sum(1) > 0).mean() > 0.99, "triangles face outwards"
    np.testing.assert_allclose(mesh.colors, (mesh.points + 1) / 2 * 255, atol=20)  # a ray sees a mean along it
    with pytest.raises(ValueError, match=r"nowhere in the scene: it lies between .* and .* there; set another --level"):
        surfaces.mesh(ball, hits, cells=10, level=1e6)


def test_points_lie_where_rays_end_with_normals_towards_the_cameras(ball):
    hits = surfaces.ray_ends(ball, 10_000)
    assert not len(surfaces.ray_ends(ball, 10).points) > 10
    cloud = surfaces.cloud(hits)
    assert 0 < len(cloud.points) <= len(hits.points)
    np.testing.assert_allclose(np.linalg.norm(cloud.normals, axis=1), 1)
    with pytest.raises(ValueError, match=r"no ray of a training view ends within 0\.001"):
        surfaces.ray_ends(ball, 100, within=0.001)


def test_normals_of_points_on_a_ball_are_its_radii():
    points = torch.randn(2000, 3, generator=torch.Generator().manual_seed(0))
    points = points / points.norm(dim=1, keepdim=True)
    far = torch.tensor([[9.0, 9, 9]])
    hits = surfaces.Hits(torch.cat([points, far]), -torch.cat([points, far]), torch.zeros(2001, 3))
    cloud = surfaces.cloud(hits)
    assert len(cloud.points) == 2000, "the isolated point is dropped"
    assert (cloud.normals * cloud.points).sum(1).min() > 0.95


def read(content: bytes):
    """A PLY file as trimesh reads it."""
    trimesh = pytest.importorskip("trimesh", reason="trimesh is not installed")
    return trimesh.load(io.BytesIO(content), file_type="ply", process=False)


def test_a_ply_file_is_what_others_read():
    random = np.random.default_rng(0)
    normals = random.normal(size=(5, 3)).astype(np.float32)
    one = ply.Surface(normals + 1, normals, random.integers(0, 256, (5, 3), np.uint8), np.array([[0, 1, 2], [2, 3, 4]]))
    for surface in (one, dataclasses.replace(one, faces=None)):
        theirs = read(ply.encode(surface))
        np.testing.assert_array_equal(theirs.vertices.astype(np.float32), one.points)
        colors = theirs.colors if surface.faces is None else theirs.visual.vertex_colors
        np.testing.assert_array_equal(colors[:, :3], one.colors)
    mesh = read(ply.encode(one))
    np.testing.assert_array_equal(mesh.faces, one.faces)
    data = mesh.metadata["_ply_raw"]["vertex"]["data"]
    np.testing.assert_array_equal(np.stack([data[name] for name in ("nx", "ny", "nz")], axis=1), normals)


def test_the_command_writes_points_in_the_coordinates_of_transforms_json(tiny_run, trained, tmp_path, capsys):
    out = tmp_path / "out"
    assert main.dispatch("export", [str(tiny_run), "--to", "points", "--within", "900", "--out", str(out)]) == 0
    assert "step 3, " in capsys.readouterr().out
    content = (out / f"{tiny_run.name}.ply").read_bytes()
    file = tmp_path / "one.ply"
    assert main.dispatch("export", [str(tiny_run), "--to", "points", "--within", "900", "--out", str(file)]) == 0
    assert file.read_bytes() == content
    assert main.dispatch("export", [*[str(tiny_run)] * 2, "--to", "points", "--out", str(file)]) == 2
    assert "expected a folder for 2 runs" in capsys.readouterr().err
    assert main.dispatch("export", [str(tiny_run), "--to", "mesh", "--out", str(tmp_path / "x.OBJ")]) == 2
    assert "expected a folder or NAME.ply" in capsys.readouterr().err
    assert main.dispatch("export", [str(tiny_run), "--to", "points", "--within", "0.001", "--out", str(out)]) == 2
    assert f"error: {tiny_run.name}: no ray" in capsys.readouterr().err
    written = np.asarray(read(content).vertices)
    mine = surfaces.cloud(surfaces.ray_ends(Renderer(trained), 10**6, 900))
    homogeneous = np.concatenate([written, np.ones((len(written), 1))], axis=1)
    np.testing.assert_allclose(
        homogeneous @ trained.scene.transform.numpy().T[:, :3], mine.points, rtol=1e-4, atol=1e-4
    )
