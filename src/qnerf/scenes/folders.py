"""What a scene's folder holds: the files that a format names, and how to go on with a folder of something else."""

import os
import posixpath
import re
import shlex
import unicodedata
from collections.abc import Collection, Iterator
from pathlib import Path

FORMATS: dict[str, tuple[str, ...]] = {}
"""Format -> files that tell it, relative to a scene's folder. Each reader adds its own."""
PHOTOGRAPHS = (".jpg", ".jpeg", ".png", ".tif", ".tiff", ".webp", ".bmp", ".ppm")
SUFFIXES = ("", ".png", *(suffix for suffix in PHOTOGRAPHS if suffix != ".png"))
"""What a name without a suffix may lack, in the order in which instant-ngp tries it."""
VIDEOS = (".mp4", ".mov", ".avi", ".mkv", ".webm", ".m4v")
SMALLER = (2, 4, 8)  # factors in the names of folders with reduced images: images_2, images_4, images_8


class SceneFolder:
    """A scene's folder. It finds images by the names that the files of a format give them.

    Args:
        path: `scene.path`.

    Raises:
        ValueError: there is no such folder.
    """

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path).expanduser()
        self._entries: dict[Path, dict[str, list[Path]]] = {}
        if self.path.is_file() and self.path.suffix.lower() in VIDEOS:
            raise ValueError(f"scene.path={str(path)!r} is a video; {capture_hint(self.path)}")
        if not self.path.is_dir():
            state = "is not a folder" if self.path.exists() else "does not exist"
            parent = f": scene.path={self.path.parent}" if self.path.is_file() else ""
            raise ValueError(f"scene.path={str(path)!r} {state}; expected a folder with posed images{parent}")

    def file(self, name: str) -> Path:
        """The file `name` of a format; ValueError says what the folder holds instead, and how to go on."""
        if not (self.path / name).is_file():
            raise ValueError(f"scene.path={str(self.path)!r} has no {name}{contents(self.path, [name])}")
        return self.path / name

    def image(self, name: str) -> Path | None:
        """The image file that `name` stands for; None if it does not exist.

        A backslash may stand for a slash, the suffix may be missing or written twice, and letter case and Unicode form
        may differ. A path that leads to nothing outside stands for a file inside the folder, which has moved since.

        Raises:
            ValueError: the name leads out of the folder, or stands for several files.
        """
        return next((path for place in self._places(name) if (path := self._named(place)) is not None), None)

    def smaller(self, name: str) -> Path | None:
        """The image in `images_2`, `images_4` or `images_8` that stands for `images/...`, the largest; None: there is
        none. Its suffix may be another one."""
        first, _, rest = posixpath.normpath(name.replace("\\", "/")).partition("/")
        found = (
            self._named(f"{first}_{factor}/{other}")
            for factor in SMALLER
            for other in (rest, posixpath.splitext(rest)[0])
            if rest
        )
        return next((path for path in found if path is not None), None)

    def relative(self, path: Path) -> str:
        """The path of a file in the folder, relative to it."""
        return path.relative_to(self.path).as_posix()

    def _places(self, name: str) -> Iterator[str]:
        """Relative paths that a name may stand for, the most likely one first."""
        slashed = re.sub(r"^[A-Za-z]:/", "/", name.replace("\\", "/"))
        if "\\" in name and (self.path / name).is_file():
            yield name
        root = os.path.abspath(self.path)
        target = os.path.normpath(os.path.join(root, slashed))
        for base in (root, os.path.realpath(root)):
            if os.path.commonpath([base, target]) == base:
                yield os.path.relpath(target, base)
                return
        if any(os.path.exists(target + suffix) for suffix in SUFFIXES):
            raise ValueError(
                f"{self.path}: image {name!r} lies outside the scene's folder; copy it into the folder, and write its "
                "path relative to the folder"
            )
        parts = [part for part in posixpath.normpath(slashed).split("/") if part not in ("", "..")]
        for first in range(len(parts)):
            yield "/".join(parts[first:])

    def _named(self, relative: str) -> Path | None:
        for suffix in SUFFIXES:
            if os.path.isfile(self.path / (relative + suffix)):
                return self.path / (relative + suffix)
        alike = self._alike(posixpath.normpath(relative).split("/"))
        if len(alike) > 1:
            several = ", ".join(sorted(self.relative(path) for path in alike))
            raise ValueError(f"{self.path}: image {relative!r} may stand for {several}; write the name of one of them")
        return alike[0] if alike else None

    def _alike(self, parts: list[str]) -> list[Path]:
        """Image files whose path is `parts`, apart from letter case, Unicode form, and the suffix of the last part."""
        places = [self.path]
        for part in parts[:-1]:
            places = [path for place in places for path in self._list(place).get(_folded(part), [])]
        stem, suffix = posixpath.splitext(_folded(parts[-1]))
        names = [stem + suffix + more for more in SUFFIXES]
        if suffix in PHOTOGRAPHS and posixpath.splitext(stem)[1] in PHOTOGRAPHS:
            names.append(stem)
        return [
            path for place in places for name in names for path in self._list(place).get(name, []) if path.is_file()
        ]

    def _list(self, place: Path) -> dict[str, list[Path]]:
        """The entries of a folder by their folded names; each folder is read once."""
        if place not in self._entries:
            self._entries[place] = {}
            for path in place.iterdir() if place.is_dir() else []:
                self._entries[place].setdefault(_folded(path.name), []).append(path)
        return self._entries[place]


def _folded(name: str) -> str:
    """Equal for names that differ only in letter case or Unicode form."""
    return unicodedata.normalize("NFC", unicodedata.normalize("NFC", name).casefold())


def photographs(folder: Path) -> list[Path]:
    """The images directly in a folder, sorted by name, without hidden files; empty if there is no such folder."""
    if not folder.is_dir():
        return []
    files = (path for path in folder.iterdir() if path.suffix.lower() in PHOTOGRAPHS and path.is_file())
    return sorted(path for path in files if not path.name.startswith("."))


def capture_hint(source: Path) -> str:
    return f"`qnerf capture {shlex.quote(str(source))} --out DIR` finds the poses and writes a scene"


def contents(folder: Path, besides: Collection[str] = ()) -> str:
    """What a folder holds that a scene can be made from, as the second half of a message; empty if it holds nothing.

    besides: files of the format that was looked for, which is not advised again.
    """
    held = [(kind, file) for kind, files in FORMATS.items() for file in files if (folder / file).is_file()]
    if other := next(((kind, file) for kind, file in held if not set(besides) & set(FORMATS[kind])), None):
        return f"; it has {other[1]}: use scene={other[0]}"
    for place in (folder / "images", folder):
        if found_images := photographs(place):
            return f"; it has {len(found_images)} images without poses: {capture_hint(place)}"
    inside = [] if held else sorted(place for depth in ("*/", "*/*/") for place in folder.glob(depth))
    for place, kind in ((place, kind) for place in inside for kind in FORMATS):
        if any((place / file).is_file() for file in FORMATS[kind]):
            return f"; a folder in it is a scene: use scene={kind} scene.path={shlex.quote(str(place))}"
    videos = sorted(path for path in folder.iterdir() if path.suffix.lower() in VIDEOS)
    return f"; it has a video: {capture_hint(videos[0])}" if videos else ""
