"""Scenes that hardly fit into memory, or do not: they are read once, or refused with one line before they are read."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from qnerf.config import memory
from qnerf.geometry import rays
from qnerf.scenes import SCENES
from tests.helpers import worlds
from tests.helpers.scenes import write_scene

resource = pytest.importorskip("resource")
MIB = 2**20
VIEWS, WIDTH, HEIGHT = 24, 2048, 2048
READ = """
import resource, sys
from pathlib import Path
from qnerf.scenes import SCENES
used = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
resource.setrlimit(resource.RLIMIT_AS, (used + int(sys.argv[2]),) * 2)
try:
    scene = SCENES.build("nerfstudio", path=sys.argv[1])
except ValueError as error:
    print(error)
else:
    print(tuple(scene.images.shape), int(scene.images[-1, 0, 0, 0]))
"""


def large(folder: Path, mode: str) -> Path:
    write_scene(folder, VIEWS, 4, 4)
    file = folder / "transforms.json"
    file.write_text(file.read_text().replace('"w": 4, "h": 4', f'"w": {WIDTH}, "h": {HEIGHT}').replace("8.0", "2048.0"))
    image = Image.new(mode, (WIDTH, HEIGHT), (9, 8, 7, 255)[: len(mode)])
    for view in range(VIEWS):
        image.save(folder / "images" / f"{view:03d}.png", compress_level=1)
    return folder


def read(folder: Path, allowed: int) -> str:
    """What a process prints that may take `allowed` bytes more than it has when qnerf is imported."""
    command = [sys.executable, "-c", READ, str(folder), str(allowed)]
    result = subprocess.run(command, capture_output=True, text=True)
    assert not result.stderr
    assert result.returncode == 0
    return result.stdout.strip()


@pytest.mark.skipif(not Path("/proc/self/statm").exists(), reason="the used address space is read from /proc")
def test_a_scene_that_fits_once_is_read_and_one_that_does_not_is_one_line(tmp_path: Path) -> None:
    for mode, channels in (("RGB", 3), ("RGBA", 4)):
        folder = large(tmp_path / mode, mode)
        size = VIEWS * WIDTH * HEIGHT * channels
        assert read(folder, int(2.9 * size)) == f"({VIEWS}, {HEIGHT}, {WIDTH}, 3) 9"  # opaque RGBA is RGB
        message = read(folder, size - MIB)
        assert f"{folder}: 24 images would take " in message
        assert message.endswith("MiB are available; use a larger scene.downscale or a smaller scene.width")
        assert "\n" not in message


def test_alpha_is_dropped_in_place_and_filled_in(tmp_path: Path) -> None:
    folder = write_scene(tmp_path / "scene", channels=4)
    pixels = [np.asarray(Image.open(file)).copy() for file in sorted((folder / "images").iterdir())]
    for view, image in enumerate(pixels):
        image[..., 3] = 255
        Image.fromarray(image).save(folder / "images" / f"{view:03d}.png")
    scene = SCENES.build("nerfstudio", path=str(folder))
    np.testing.assert_array_equal(scene.images, np.stack(pixels)[..., :3])
    pixels[2][0, 0, 3] = 7  # one transparent pixel, and one image without alpha
    Image.fromarray(pixels[2]).save(folder / "images" / "002.png")
    Image.fromarray(pixels[4][..., :3]).save(folder / "images" / "004.png")
    np.testing.assert_array_equal(SCENES.build("nerfstudio", path=str(folder)).images, np.stack(pixels))


def test_the_table_of_rays_says_what_it_would_take(monkeypatch: pytest.MonkeyPatch) -> None:
    scene = worlds.ball(views=4, size=32)
    monkeypatch.setattr(memory, "available_bytes", lambda: 1000)
    with pytest.raises(ValueError, match=r"the table of 1,024 rays would take .* available"):
        rays.RayTable(scene)


def test_rays_computed_in_parts_are_the_same(monkeypatch: pytest.MonkeyPatch) -> None:
    scene = worlds.ball(views=4, size=32)
    whole = rays.RayTable(scene, validation_stride=7)
    monkeypatch.setattr(rays, "PART", 96)
    parts = rays.RayTable(scene, validation_stride=7)
    assert torch.equal(whole.directions, parts.directions)
    numbers = torch.arange(6, 3 * 32 * 32, 7)  # the held-out pixels, one by one
    chosen = numbers[torch.linspace(0, len(numbers) - 1, 50, dtype=torch.float64).long()]
    held_out, colors = parts.validation(50)
    views, pixels = torch.div(chosen, 32 * 32, rounding_mode="floor"), chosen % (32 * 32)
    assert torch.equal(held_out.directions, parts.rays(views, pixels).directions)
    assert torch.equal(colors, parts.colors[chosen].float() / 255)
