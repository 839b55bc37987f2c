"""The interactive viewer: a page in the browser that shows what a model sees from wherever the user looks.

Pictures come in steps: a coarse one at once, which a moving camera keeps replacing, and sharper ones once it is still.
"""

import contextlib
import io
import math
import socket
import threading
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from qnerf.geometry.camera_paths import Camera
from qnerf.records import StoreError
from qnerf.viewing.frames import Renderer
from qnerf.viewing.guard import Guard
from qnerf.viewing.painter import WHAT, Painter

COARSE, MIDDLE = 64, 192  # pixels: widths of the first two pictures
ASPECT = 4.0
FOV = (0.01, 3.1)  # radians
POLL = 2.0  # seconds between looks at the checkpoints
FRUSTA = 300  # cameras that are drawn, at most
FLIP = np.diag([1.0, -1.0, -1.0])  # between OpenGL's camera axes and OpenCV's, which viser has


def sharpen(
    version: Callable[[], int],
    draw: Callable[[int, Callable[[], bool]], NDArray | None],
    show: Callable[[NDArray], None],
    widths: Sequence[int],
) -> bool:
    """Shows ever sharper pictures of what is to be seen now, until that changes; returns whether all were shown.

    version: a number that changes with the camera and with what is shown. draw: a picture of a width, or None where the
    function that it gets was true in between. widths: pixels; the first picture is always completed.
    """
    start = version()

    def changed() -> bool:
        return version() != start

    for number, width in enumerate(widths):
        picture = draw(width, changed if number else lambda: False)
        if picture is None:
            return False
        show(picture)
        if changed():
            return False
    return True


class Client(threading.Thread):
    """Serves one browser: sends it pictures for as long as its page is open."""

    def __init__(self, viewer: "Viewer", client: Any) -> None:
        super().__init__(name=f"qnerf-view-{client.client_id}", daemon=True)
        self.viewer, self.client = viewer, client
        self.version = 0
        self.news = threading.Event()
        self.open = True

    def changed(self, *_: Any) -> None:
        """Redraws."""
        self.version += 1
        self.news.set()

    def close(self) -> None:
        self.open = False
        self.changed()

    def camera(self, width: int) -> Camera:
        """Where the user looks from, in a picture of this width."""
        seen = self.client.camera
        return camera_of(seen.wxyz, seen.position, seen.fov, seen.aspect, width)

    def run(self) -> None:
        while self.open:
            self.news.wait()
            self.news.clear()
            with contextlib.suppress(ValueError):  # such as a rotation of zeros
                if not self.open:
                    return
                sharpen(lambda: self.version, self._draw, self._show, self.viewer.widths)

    def _draw(self, width: int, stopping: Callable[[], bool]) -> NDArray | None:
        def ended() -> bool:
            return stopping() or not self.open

        return self.viewer.painter.picture(self.camera(width), self.viewer.what.value, ended)

    def _show(self, picture: NDArray) -> None:
        if self.open:
            self.client.scene.set_background_image(picture, format="jpeg", jpeg_quality=90)


def camera_of(wxyz: NDArray, position: NDArray, fov: float, aspect: float, width: int) -> Camera:
    """viser's camera (OpenCV's axes, vertical field of view in radians) as ours.

    The numbers come from a browser: pictures are at most `ASPECT` times as high as wide, or as wide as high.
    """
    height = max(1, round(width / min(max(1 / ASPECT, aspect), ASPECT)))
    fov = min(max(FOV[0], fov), FOV[1])
    rotation = Rotation.from_quat(np.asarray(wxyz), scalar_first=True).as_matrix() @ FLIP
    pose = np.concatenate([rotation, np.asarray(position)[:, None]], axis=1)
    return Camera(pose, height / 2 / math.tan(fov / 2), width, height)


def quaternion(pose: NDArray) -> NDArray:
    """A pose's (3, 4) rotation as viser has it: w x y z, of OpenCV's axes."""
    return np.asarray(Rotation.from_matrix(pose[:, :3] @ FLIP).as_quat(scalar_first=True))


class Viewer:
    """The server of a run's page. It runs in threads of its own until `stop`.

    width: of the sharpest picture, pixels. ValueError where the port is taken.
    """

    def __init__(self, renderer: Renderer, host: str = "127.0.0.1", port: int = 8080, width: int = 640):
        import viser

        self.painter = Painter(renderer)
        self.painter.reload()
        self.widths = sorted({min(size, width) for size in (COARSE, MIDDLE, width)})
        require_free(host, port)
        self.guard = Guard(host)
        with self.guard.installed(), contextlib.redirect_stdout(io.StringIO()):  # it prints a banner
            self.server = viser.ViserServer(host=host, port=port, label="qnerf", verbose=False)
        self.clients: dict[int, Client] = {}
        self.stopped = threading.Event()
        self._add_controls()
        self._add_cameras()
        self.server.on_client_connect(self._connect)
        self.server.on_client_disconnect(self._disconnect)
        self.follower = threading.Thread(target=self._follow, name="qnerf-view-follow", daemon=True)
        self.follower.start()

    @property
    def address(self) -> str:
        """Where the page is, with the token that it wants."""
        return self.guard.address(self.server.get_port())

    def stop(self) -> None:
        """Closes the server. Threads have ended on return: one that still draws as Python ends may abort it."""
        self.stopped.set()
        clients = list(self.clients.values())
        for client in clients:
            client.close()
        for thread in (self.follower, *clients):
            thread.join(10)
        with contextlib.redirect_stdout(io.StringIO()):
            self.server.stop()

    def _add_controls(self) -> None:
        gui = self.server.gui
        self.text = gui.add_markdown("")
        self.what = gui.add_dropdown("picture", WHAT)
        self.cameras = gui.add_checkbox("cameras", True)
        self.what.on_update(lambda _: self._changed())
        self.cameras.on_update(lambda _: self._show_cameras())
        self.text.content = self.painter.text()

    def _add_cameras(self) -> None:
        scene = self.painter.renderer.trained.scene
        views = sorted({*scene.train, *scene.eval})
        chosen = [views[index] for index in np.linspace(0, len(views) - 1, min(FRUSTA, len(views))).astype(int)]
        self.frusta = []
        for view in chosen:
            pose = scene.cameras.poses[view].numpy()
            half_height = float(scene.cameras.cy[view] / scene.cameras.fy[view])
            half_width = float(scene.cameras.cx[view] / scene.cameras.fx[view])
            frustum = self.server.scene.add_camera_frustum(
                f"/cameras/{view}",
                2 * math.atan(half_height),
                half_width / half_height,
                scale=0.05,
                thickness=1.5,
                thickness_units="screen",
                color=(230, 120, 20) if view in scene.eval else (40, 90, 200),
                wxyz=quaternion(pose),
                position=pose[:, 3],
            )
            frustum.on_click(partial(self._clicked, pose))
            self.frusta.append(frustum)

    def _show_cameras(self) -> None:
        for frustum in self.frusta:
            frustum.visible = self.cameras.value

    def _clicked(self, pose: NDArray, event: Any) -> None:
        self._look_from(event.client, pose)

    def _look_from(self, client: Any, pose: NDArray) -> None:
        with client.atomic():
            client.camera.position = pose[:, 3]
            client.camera.look_at = pose[:, 3] - pose[:, 2]
            client.camera.up_direction = (0.0, 0.0, 1.0)

    def _connect(self, client: Any) -> None:
        scene = self.painter.renderer.trained.scene
        view = scene.eval[0]
        self._look_from(client, scene.cameras.poses[view].numpy())
        client.camera.fov = 2 * math.atan(float(scene.cameras.cy[view] / scene.cameras.fy[view]))
        served = self.clients[client.client_id] = Client(self, client)
        client.camera.on_update(served.changed)
        served.start()
        served.changed()

    def _disconnect(self, client: Any) -> None:
        served = self.clients.pop(client.client_id, None)
        if served is not None:
            served.close()

    def _changed(self) -> None:
        for client in list(self.clients.values()):
            client.changed()

    def _follow(self) -> None:
        """Takes the checkpoints of a run that is being trained as they come."""
        while not self.stopped.wait(POLL):
            try:
                if self.painter.reload():
                    self._changed()
                self.text.content = self.painter.text()
            except (StoreError, ValueError) as error:  # it is being replaced, or the run was deleted
                self.text.content = str(error)


def require_free(host: str, port: int) -> None:
    """ValueError unless a server can listen there."""
    try:
        with socket.socket(socket.AF_INET6 if ":" in host else socket.AF_INET) as test:
            test.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            test.bind((host, port))
    except OSError as error:
        raise ValueError(f"{host}:{port}: {error.strerror}; choose another with --port or --host") from None
