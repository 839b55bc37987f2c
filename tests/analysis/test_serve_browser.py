"""The live page in a real browser: a run in training is watched, at two widths, by keyboard alone."""

import pytest
from qnerf.analysis.serve import store as serve_store
from selenium.webdriver.common.keys import Keys

from qnerf.records import RunStore
from tests.helpers.browser import chromium
from tests.helpers.packed_stores import write_run
from tests.helpers.serving import EVIL, served


@pytest.fixture(scope="module")
def browser(tmp_path_factory):
    with chromium(tmp_path_factory.mktemp("chromium")) as driver:
        yield driver


@pytest.fixture
def live(browser, tmp_path, monkeypatch):
    """A store with two fields and three seeds each, and its page."""
    monkeypatch.setattr(serve_store, "FRESH", 0.0)
    for seed in range(3):
        write_run(tmp_path, seed=seed, psnr=(20.0 + seed, 22.0))
        write_run(tmp_path, "qcolor", seed=seed, psnr=(21.0 + seed, 22.5))
    with served(tmp_path) as (address, token):
        browser.get(f"{address}/?token={token}")
        yield tmp_path, address
        browser.get("about:blank")


def test_a_run_appears_trains_and_finishes_without_a_reload(browser, live):
    store, address = live
    browser.opened(address, plots=False)
    assert len(browser.rows()) == 6
    browser.execute_script("window.sameDocument = true")
    run = RunStore(store).claim("new", {"seed": 0, "train": {"steps": 10}, "experiment": EVIL}).run
    run.log(1, 0.1, {"eval/psnr": 12.0})
    run.flush()
    browser.wait(lambda: "running" in browser.column(browser.heads().index("state")))
    browser.wait(lambda: "held-out PSNR 12.00 dB at step 1" in browser.by_id("training").text)
    browser.execute_script("document.getElementById('curves-section').scrollIntoView({behavior: 'instant'})")
    drawn = "return (document.getElementById('curves-plot').data ?? []).map((t) => t.y.length)"
    browser.choose("state", "running")
    browser.wait(lambda: browser.execute_script(drawn) == [1])
    run.log(2, 0.2, {"eval/psnr": 13.0})
    run.flush()
    browser.wait(lambda: browser.execute_script(drawn) == [2])
    run.finish({"psnr": 40.0})
    browser.choose("state", "")
    browser.wait(lambda: browser.column(2)[0] == "40.00")
    assert browser.execute_script("return window.sameDocument")
    assert {address.rpartition("/")[0] for address in browser.requested()} == {address}
    assert browser.errors() == []


@pytest.mark.parametrize("width", [390, 1280])
def test_the_page_is_used_by_keyboard_alone(browser, live, width):
    _, address = live
    browser.opened(f"{address}/#filter=qcolor-s1", width, "dark", plots=False)
    browser.wait(lambda: len(browser.rows()) == 1)
    assert browser.overflow() == 0
    browser.by_id("csv").send_keys(Keys.TAB, Keys.TAB)  # the scrolling table, its first heading
    for _ in range(40):
        if browser.switch_to.active_element.tag_name == "a":
            break
        browser.switch_to.active_element.send_keys(Keys.TAB)
    browser.switch_to.active_element.send_keys(Keys.ENTER)
    browser.wait(lambda: browser.by_id("detail").get_attribute("open"))
    browser.switch_to.active_element.send_keys(Keys.ESCAPE)
    browser.by_id("filter").clear()
    browser.by_id("row-keys").send_keys("field", Keys.TAB, "field=classical", Keys.ENTER)
    table = browser.wait(lambda: browser.all("#differences-table tbody tr"))
    assert "+0.75 ±" in table[1].text
    assert browser.overflow() == 0
    assert browser.errors() == []
