"""Images from elsewhere: none is decoded that would fill the memory, none but pictures is opened."""

import io
import struct
import zlib
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from qnerf.scenes import SCENES, images
from tests.helpers.scenes import write_scene


def chunk(kind: bytes, body: bytes) -> bytes:
    return struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))


def png(width: int, height: int, *, depth: int = 8, color: int = 2, extra: bytes = b"", pixels: bytes = b"") -> bytes:
    header = chunk(b"IHDR", struct.pack(">IIBBBBB", width, height, depth, color, 0, 0, 0))
    return b"\x89PNG\r\n\x1a\n" + header + extra + chunk(b"IDAT", zlib.compress(pixels)) + chunk(b"IEND", b"")


def encoded(kind: str, size: tuple[int, int], **options: object) -> bytes:
    data = io.BytesIO()
    Image.new("L", size).save(data, kind, **options)
    return data.getvalue()


ZEROS = zlib.compress(bytes(2**28))  # a quarter of a gigabyte in a quarter of a megabyte
BOMBS = {
    "header": png(60_000, 60_000),
    "largest header": png(2**31 - 1, 2**31 - 1),
    "16 bits": png(9_000, 9_000, depth=16, color=6),
    "whole": png(12_000, 12_000, depth=1, color=0, pixels=bytes(12_000 * 1501)),
    "tiff": encoded("TIFF", (12_000, 12_000), compression="tiff_adobe_deflate"),
    "webp": encoded("WEBP", (16_000, 8_000)),
    "profile": png(8, 6, extra=chunk(b"iCCP", b"x\0\0" + ZEROS), pixels=bytes(6 * 25)),
    "text": png(8, 6, extra=chunk(b"zTXt", b"x\0\0" + ZEROS), pixels=bytes(6 * 25)),
}


@pytest.mark.parametrize("data", BOMBS.values(), ids=BOMBS)
def test_bombs_are_not_decoded(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, data: bytes) -> None:
    folder = write_scene(tmp_path / "scene")
    (folder / "images" / "003.png").write_bytes(data)

    def decoded(image: Image.Image) -> None:
        raise AssertionError(f"{image.size} was decoded")

    monkeypatch.setattr(images, "_pixels", decoded)
    with pytest.raises(ValueError, match=r"'images/003\.png'") as error:
        SCENES.build("nerfstudio", path=str(folder))
    assert "\n" not in str(error.value)
    assert "was decoded" not in str(error.value)


@pytest.mark.parametrize(
    "data",
    [
        b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 8 6\n",
        b"<svg xmlns='http://www.w3.org/2000/svg'><image href='file:///etc/passwd'/></svg>",
        b"%PDF-1.4\n",
        encoded("GIF", (8, 6)),
        encoded("ICO", (8, 6)),
    ],
    ids=["eps", "svg", "pdf", "gif", "ico"],
)
def test_formats_that_could_do_more_are_not_opened(tmp_path: Path, data: bytes) -> None:
    folder = write_scene(tmp_path / "scene")
    (folder / "images" / "003.png").write_bytes(data)
    with pytest.raises(ValueError, match=r"'images/003\.png' cannot be read: not one of PNG, JPEG"):
        SCENES.build("nerfstudio", path=str(folder))


@pytest.mark.parametrize(("pixels", "workers"), [(48, 4), (1000, 2), (2000, 1)])
def test_large_images_are_decoded_one_by_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, pixels: int, workers: int
) -> None:
    folder = write_scene(tmp_path / "scene", width=pixels // 6)
    asked = []

    class Pool(images.ThreadPoolExecutor):  # type: ignore[name-defined,misc]
        def __init__(self, most: int) -> None:
            asked.append(most)
            super().__init__(most)

    monkeypatch.setattr(images, "ThreadPoolExecutor", Pool)
    monkeypatch.setattr(images, "MAX_PIXELS", 2100)
    monkeypatch.setattr("os.cpu_count", lambda: 64)
    scene = SCENES.build("nerfstudio", path=str(folder))
    assert asked == [workers]
    truth = np.asarray(Image.open(folder / "images" / "002.png"))
    np.testing.assert_array_equal(scene.images[2], truth)
