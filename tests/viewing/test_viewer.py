"""The viewer: its pictures, its render loop, and its server as a browser talks to it."""

import contextlib
import io
import math
import random
import shutil
import socket
import sys
import time
import urllib.request

import numpy as np
import pytest
import torch
from PIL import Image

from qnerf.cli import main
from qnerf.experiment import run
from qnerf.geometry.camera_paths import Camera
from qnerf.probes import load
from qnerf.training.evaluation import shade
from qnerf.viewing.frames import Renderer, as_bytes
from qnerf.viewing.guard import COOKIE, Guard
from qnerf.viewing.painter import Painter
from qnerf.viewing.viewer import Viewer, camera_of, quaternion, require_free, sharpen
from tests.helpers.configs import TINY, composed
from tests.helpers.scenes import write_scene
from tests.helpers.stopping import StopsWhen

DEADLINE = 60.0  # seconds, for a busy machine
WEBGL = ("--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--window-size=900,700")


def camera(trained, view=0, width=12):
    return Camera(trained.scene.cameras.poses[view].numpy(), 8.0 * width / 12, width, width * 2 // 3)


def free_port():
    """Below those that the system deals out itself, so that no other server or browser takes it in between."""
    while True:
        port = random.SystemRandom().randrange(20_000, 30_000)
        with contextlib.suppress(ValueError):
            require_free("127.0.0.1", port)
            return port


# Pictures


def test_a_camera_goes_to_the_browser_and_back(trained):
    pose = trained.scene.cameras.poses[2].numpy()
    back = camera_of(quaternion(pose), pose[:, 3], 2 * math.atan(4 / 8), 1.5, 24)
    np.testing.assert_allclose(back.pose, pose, atol=1e-12)
    assert (back.width, back.height, back.focal) == (24, 16, pytest.approx(16))


def test_viewer_bounds_what_a_browser_may_ask_for():
    place = np.array([1.0, 0, 0, 0]), np.zeros(3)
    for aspect, height in ((1e-3, 96), (1e9, 6), (math.nan, 96)):
        asked = camera_of(*place, 1.0, aspect, 24)
        assert (asked.width, asked.height) == (24, height)
    for fov in (0.0, math.pi, -1.0, math.nan):
        assert 0 < camera_of(*place, fov, 1.0, 24).focal < 1e5


def test_pictures_of_colour_and_depth(trained):
    painter, here = Painter(Renderer(trained)), camera(trained)
    frame = painter.renderer.frame(here)
    np.testing.assert_array_equal(painter.picture(here, "color"), as_bytes(frame.color))
    np.testing.assert_array_equal(painter.picture(here, "depth"), as_bytes(shade(frame.depth)))
    assert painter.picture(here, "color", lambda: True) is None


def test_pictures_become_sharper_until_the_view_changes():
    shown, version, moves = [], [0], []

    def draw(width, changed):
        if width == 300 and moves.pop():
            version[0] += 1
        return None if changed() else np.zeros((1, width, 3))

    for move, widths in ((False, [60, 200, 300]), (True, [60, 200])):
        shown.clear()
        moves[:] = [move]
        complete = sharpen(lambda: version[0], draw, lambda picture: shown.append(picture.shape[1]), [60, 200, 300])
        assert (complete, shown) == (not move, widths)
    # The first picture is finished and shown while the camera moves.
    shown.clear()
    assert not sharpen(lambda: time.monotonic_ns(), draw, lambda picture: shown.append(picture.shape[1]), [60, 200])
    assert shown == [60]


def test_checkpoints_are_taken_as_they_come(trained, tmp_path):
    shutil.copytree(trained.folder, tmp_path / trained.folder.name)
    own = load(tmp_path / trained.folder.name)
    painter = Painter(Renderer(own))
    assert painter.reload()
    assert not painter.reload()
    file = own.folder / "checkpoint.pt"
    content = torch.load(file, weights_only=True)
    content["step"] = 2
    content["model"] = {name: value.clone().zero_() for name, value in content["model"].items()}
    torch.save(content, file)
    assert painter.reload()
    assert painter.renderer.trained.step == 2
    assert all(not bool(value.any()) for value in own.model.state_dict().values())
    assert painter.text() == f"{own.folder.name}: finished, checkpoint of step 2 of 3"
    file.write_bytes(b"PK no checkpoint")
    with pytest.raises(ValueError, match="expected the checkpoint of this run"):
        painter.reload()


# Mistakes


def test_a_taken_port_and_a_missing_extra_are_one_line(tiny_run, capsys, monkeypatch):
    with socket.socket() as listener:
        listener.bind(("127.0.0.1", 0))
        listener.listen()
        port = listener.getsockname()[1]
        with pytest.raises(ValueError, match=f"{port}: Address already in use; choose another with --port"):
            require_free("127.0.0.1", port)
    monkeypatch.setitem(sys.modules, "viser", None)
    assert main.dispatch("view", [str(tiny_run)]) == 2
    err = capsys.readouterr().err
    assert 'viser is not installed: pip install "qnerf[view]"' in err
    assert err.count("\n") == 1


# A real server


@pytest.fixture
def viewer(ball):
    served = Viewer(ball, port=free_port(), width=96)
    yield served
    served.stop()


def test_requests_without_the_token_or_from_another_site_are_refused():
    guard, everywhere = Guard("127.0.0.1"), Guard("0.0.0.0")
    query, own = f"/?token={guard.token}", {"Host": "127.0.0.1:8080"}
    cookie = {"Cookie": f"a=b; {COOKIE}={guard.token}"}
    assert guard.refusal(query, own) is None
    assert guard.refusal("/", own | cookie) is None
    assert guard.refusal("/", own | cookie | {"Origin": "http://127.0.0.1:8080"}) is None
    assert guard.refusal("/", {"Host": "[::1]:8080"} | cookie) is None
    assert everywhere.refusal(f"/?token={everywhere.token}", {"Host": "gpu.example.org"}) is None
    for path, headers, reason in (
        ("/", own, "expected the token"),
        ("/?token=x", own | {"Cookie": f"{COOKIE}=\xe9"}, "expected the token"),
        (query, own | {"Origin": "http://example.org"}, "another site"),
        (query, own | {"Origin": "http://127.0.0.1:9000"}, "another site"),
        (query, own | {"Origin": "null"}, "another site"),
        (query, {"Host": "example.org"}, "as host"),
        (query, {}, "as host"),
        (query, {"Host": "[::1"}, "expected one Host"),
        (query, own | {"Origin": "http://[::1"}, "expected one Host"),
    ):
        assert reason in guard.refusal(path, headers), (path, headers)


@pytest.mark.filterwarnings("default")
def test_the_server_asks_its_guard(viewer):
    import viser
    from websockets.exceptions import InvalidStatus
    from websockets.sync.client import connect

    address, query = viewer.address.replace("http", "ws").split("?")
    options = {"subprotocols": [f"viser-v{viser.__version__}"]}
    for url, more in ((address, {}), (f"{address}?{query}", {"origin": "http://example.org"})):
        with pytest.raises(InvalidStatus, match="403"):
            connect(url, **options, **more)
    with urllib.request.urlopen(viewer.address, timeout=DEADLINE) as answer:
        cookie = answer.headers["Set-Cookie"].split(";")[0]
    with connect(address, **options, additional_headers={"Cookie": cookie}):
        pass


class Page:
    """The viewer's page in a real browser."""

    def __init__(self, driver, address):
        from selenium.webdriver.common.by import By
        from selenium.webdriver.support.wait import WebDriverWait

        self.driver = driver
        self.wait = WebDriverWait(self.driver, DEADLINE, 0.2)
        self.driver.get(address)
        self.canvas = self.wait.until(lambda _: self.driver.find_elements(By.TAG_NAME, "canvas"))[0]

    def middle(self):
        """Pixels of the page, below its messages and left of its controls."""
        page = np.asarray(Image.open(io.BytesIO(self.driver.get_screenshot_as_png())).convert("RGB"), int)
        return page[-250:-20, 50:-350]

    def drag(self):
        from selenium.webdriver.common.action_chains import ActionChains

        held = ActionChains(self.driver).move_to_element_with_offset(self.canvas, -150, 50).click_and_hold()
        held.move_by_offset(90, 40).release().perform()

    def until(self, what, message):
        self.wait.until(lambda _: what(self.middle()), message)


@pytest.fixture
def browse(tmp_path):
    from tests.helpers.browser import chromium

    with chromium(tmp_path / "browser", *WEBGL) as driver:

        def opened(viewer):
            page = Page(driver, viewer.address)
            viewer.cameras.value = False
            return page

        yield opened


@pytest.mark.filterwarnings("default")
def test_a_run_that_trains_is_followed_in_a_browser(tmp_path, browse):
    """The run stops after its first step, is opened, and goes on: what it has learnt is seen without a reload, and from
    where the camera moves."""
    scene = write_scene(tmp_path / "scene", width=12, height=8)
    options = ("train.steps=120", "train.rays=64", "train.eval_every=0", "device=cpu", "hash=C7")
    config = composed("scene=nerfstudio", f"scene.path={scene}", *TINY, *options, f"store={tmp_path / 'runs'}")
    steps = iter(range(2))
    begun = run(config, display=StopsWhen(lambda: next(steps, None) is None))
    assert begun.state == "interrupted"
    viewer = Viewer(Renderer(load(begun.path, unfinished=True)), port=free_port(), width=64)
    try:
        page = browse(viewer)
        page.until(lambda picture: picture.std() > 1, "no picture came")
        before = page.middle()
        assert "interrupted, checkpoint of step" in viewer.text.content
        assert run(config).state == "finished"
        page.until(lambda picture: np.abs(picture - before).mean() > 3, "the picture stayed")
        page.wait.until(lambda _: "finished, checkpoint of step 120 of 120" in viewer.text.content)
        assert "step 120 of 120" in page.driver.page_source
        there = page.middle()
        page.drag()
        page.until(lambda picture: np.abs(picture - there).mean() > 3, "the picture stayed where the camera moved")
    finally:
        viewer.stop()
