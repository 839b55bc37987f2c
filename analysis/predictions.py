"""Held-out views of runs in the form that nerfbaselines evaluates, so that another program can check the metrics."""

import json
from pathlib import Path

import pandas as pd
from PIL import Image

import qnerf

from .images import panels, pictures
from .output import make_folder


def write_predictions(runs: pd.DataFrame, folder: Path) -> list[Path]:
    """Writes color/VIEW.png, gt-color/VIEW.png and info.json of each run into a folder of its own; returns these.

    The pictures are those that training stored, of 8 bits, which change a PSNR below 40 dB by less than 0.01 dB.
    `nerfbaselines evaluate FOLDER/RUN -o results.json` reads such a folder. ValueError where a picture is damaged, or
    no run has any.
    """
    written = []
    for name, path, scene in zip(runs["run_id"], runs["path"], runs["scene_name"], strict=True):
        stored = pictures(path)
        for view, picture in stored.items():
            shown = panels(picture)
            for kind, pixels in (("color", shown["render"]), ("gt-color", shown["truth"])):
                make_folder(folder / name / kind)
                Image.fromarray(pixels).save(folder / name / kind / f"{view}.png")
        if stored:
            metadata = {"color_space": "srgb", "id": "qnerf", "scene": scene, "background_color": None}
            info = {"method": "qnerf", "evaluation_protocol": "default", "render_dataset_metadata": metadata}
            text = json.dumps({"method_version": qnerf.__version__, **info}, indent=2)
            (folder / name / "info.json").write_text(text)
            written.append(folder / name)
    if not written:
        raise ValueError(f"no run of {len(runs)} has pictures of held-out views")
    return written
