"""What a folder holds: files that a scene is read from, and how to make them."""

from pathlib import Path

MODELS = ("sparse/0", "sparse", "colmap/sparse/0", ".")
"""Where a COLMAP model lies in a scene's folder."""
PHOTOGRAPHS = (".jpg", ".jpeg", ".png", ".tif", ".tiff", ".webp", ".bmp", ".ppm")
VIDEOS = (".mp4", ".mov", ".avi", ".mkv", ".webm", ".m4v")


def scene_folder(path: str | Path) -> Path:
    """`scene.path` as an existing folder; ValueError if it is none."""
    folder = Path(path).expanduser()
    if folder.is_file() and folder.suffix.lower() in VIDEOS:
        raise ValueError(f"scene.path={str(path)!r} is a video; {capture_hint(folder)}")
    if not folder.is_dir():
        state = "is not a folder" if folder.exists() else "does not exist"
        raise ValueError(f"scene.path={str(path)!r} {state}; expected a folder with posed images")
    return folder


def find_file(path: str | Path, name: str) -> Path:
    """The file `name` in `scene.path`.

    Raises:
        ValueError: the folder or the file does not exist; the message says what is there and how to go on.
    """
    folder = scene_folder(path)
    if not (folder / name).is_file():
        raise ValueError(f"scene.path={str(path)!r} has no {name}{contents(folder)}")
    return folder / name


def find_model(folder: Path) -> Path | None:
    """The folder of a COLMAP model, binary or text, inside a scene's folder."""
    places = (folder / place for place in MODELS)
    endings = (".bin", ".txt")
    return next(
        (
            place
            for place in places
            for ending in endings
            if (place / f"cameras{ending}").is_file() and (place / f"images{ending}").is_file()
        ),
        None,
    )


def photographs(folder: Path) -> list[Path]:
    """The images directly in a folder, sorted by name; empty if there is no such folder."""
    if not folder.is_dir():
        return []
    return sorted(path for path in folder.iterdir() if path.suffix.lower() in PHOTOGRAPHS and path.is_file())


def capture_hint(source: Path) -> str:
    return f"`qnerf capture {source} --out DIR` finds the poses and writes a scene"


def contents(folder: Path) -> str:
    """What a folder holds that a scene can be made from, as the second half of a message; empty if it holds nothing."""
    kinds = {"transforms.json": "nerfstudio", "transforms_train.json": "blender", "poses_bounds.npy": "llff"}
    for file, kind in kinds.items():
        if (folder / file).is_file():
            return f"; it has {file}: use scene={kind}"
    model = find_model(folder)
    if model is not None:
        return f"; it has a COLMAP model in {model.relative_to(folder)}: use scene=colmap"
    for place in (folder / "images", folder):
        if found := photographs(place):
            return f"; it has {len(found)} images without poses: {capture_hint(place)}"
    videos = sorted(path for path in folder.iterdir() if path.suffix.lower() in VIDEOS)
    return f"; it has a video: {capture_hint(videos[0])}" if videos else ""
