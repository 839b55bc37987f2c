"""What the viewer shows of a run: colour or depth, by its newest checkpoint."""

import threading
from collections.abc import Callable

from numpy.typing import NDArray

from qnerf.geometry.camera_paths import Camera
from qnerf.records import state
from qnerf.training.evaluation import shade
from qnerf.viewing.frames import Renderer, as_bytes

WHAT = ("color", "depth")


class Painter:
    """Draws pictures of a run, one at a time."""

    def __init__(self, renderer: Renderer) -> None:
        self.renderer = renderer
        self.lock = threading.Lock()
        self._written: tuple[int, int] | None = None  # of the checkpoint that is shown

    def picture(self, camera: Camera, what: str, stopping: Callable[[], bool] = lambda: False) -> NDArray | None:
        """(H, W, 3) uint8; None once `stopping()`. what: one of `WHAT`."""
        with self.lock:
            frame = self.renderer.frame(camera, stopping)
        return None if frame is None else as_bytes(frame.color if what == "color" else shade(frame.depth))

    def reload(self) -> bool:
        """Takes the checkpoint if it was written since the last call; returns whether it was."""
        try:
            found = (self.renderer.trained.folder / "checkpoint.pt").stat()
        except OSError:
            return False
        written = found.st_mtime_ns, found.st_ino
        if written == self._written:
            return False
        with self.lock:
            self.renderer.trained = self.renderer.trained.reloaded()
        self._written = written
        return True

    def text(self) -> str:
        """A line on the run: id, state, step."""
        trained = self.renderer.trained
        now = f"{state(trained.folder)}, checkpoint of step {trained.step:,} of {trained.settings.train.steps:,}"
        return f"{trained.folder.name}: {now}"
