"""The page in a real browser: Debian's Chromium without a screen, with the page opened from disk."""

import json
import shutil

import pytest

from analysis.figures import capacity_points
from analysis.load import runs
from analysis.report.__main__ import main
from analysis.report.content import prepared
from tests.helpers.packed_stores import write_run
from tests.helpers.sweep import sweep

webdriver = pytest.importorskip("selenium.webdriver", reason="selenium is not installed")
from selenium.webdriver.common.by import By  # noqa: E402
from selenium.webdriver.common.keys import Keys  # noqa: E402
from selenium.webdriver.support.wait import WebDriverWait  # noqa: E402

CHROMIUM, DRIVER = shutil.which("chromium"), shutil.which("chromedriver")
pytestmark = pytest.mark.skipif(not (CHROMIUM and DRIVER), reason="chromium and chromedriver are not installed")

ARGUMENTS = (
    "--headless",
    "--no-sandbox",
    "--disable-gpu",
    "--disable-dev-shm-usage",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
)
ABSENT = "\N{EN DASH}"
EVIL = "<img src=x onerror=alert(1)></script><script>alert(2)</script>"


@pytest.fixture(scope="module")
def store(tmp_path_factory):
    return sweep(tmp_path_factory.getbasetemp())


@pytest.fixture(scope="module")
def report(store, tmp_path_factory):
    out = tmp_path_factory.mktemp("page") / "index.html"
    main([str(store), "--out", str(out)])
    return out.as_uri()


@pytest.fixture(scope="module")
def browser(tmp_path_factory):
    options = webdriver.ChromeOptions()
    options.binary_location = CHROMIUM
    for argument in (*ARGUMENTS, f"--user-data-dir={tmp_path_factory.mktemp('chromium')}"):
        options.add_argument(argument)
    options.set_capability("goog:loggingPrefs", {"browser": "ALL", "performance": "ALL"})
    driver = webdriver.Chrome(options=options, service=webdriver.ChromeService(DRIVER))
    yield driver
    driver.quit()


@pytest.fixture
def page(browser, report):
    opened(browser, report)
    yield browser
    assert errors(browser) == []


def opened(browser, address, width=1280, scheme="light"):
    """Loads a page anew at this width (pixels) and preferred colour scheme."""
    size = {"width": width, "height": 900, "deviceScaleFactor": 1, "mobile": width < 600}
    browser.get("about:blank")
    browser.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", size)
    media = {"features": [{"name": "prefers-color-scheme", "value": scheme}]}
    browser.execute_cdp_cmd("Emulation.setEmulatedMedia", media)
    errors(browser)
    browser.get_log("performance")
    browser.get(address)
    wait(browser, lambda: browser.find_elements(By.CSS_SELECTOR, "#speed .xtitle, #plots-section .absent"))


def errors(browser):
    """What the console has said since it was last asked: errors, and violations of the page's policy."""
    return [entry["message"] for entry in browser.get_log("browser")]


def requested(browser):
    events = (json.loads(entry["message"])["message"] for entry in browser.get_log("performance"))
    sent = [event for event in events if event["method"] == "Network.requestWillBeSent"]
    addresses = {event["params"]["request"]["url"] for event in sent}
    return {address for address in addresses if not address.startswith(("data:", "about:", "chrome:"))}


def wait(browser, condition):
    return WebDriverWait(browser, 30).until(lambda _: condition())


def by_id(browser, name):
    return browser.find_element(By.ID, name)


def column(browser, number):
    """Texts of a column of the table of runs; 0 is the name."""
    return [row.find_elements(By.CSS_SELECTOR, "th, td")[number].text for row in rows(browser)]


def rows(browser):
    return browser.find_elements(By.CSS_SELECTOR, "#runs-body tr")


def heads(browser):
    return [cell.text.split("\n")[0] for cell in browser.find_elements(By.CSS_SELECTOR, "#runs-head th")]


def choose(browser, name, choice):
    script = (
        "const s = document.getElementById(arguments[0]); s.value = arguments[1]; s.dispatchEvent(new Event('change'))"
    )
    browser.execute_script(script, name, choice)


def overflow(browser):
    return browser.execute_script("return document.documentElement.scrollWidth - document.documentElement.clientWidth")


def test_nothing_is_asked_from_the_network_and_nothing_fails(page, report):
    assert requested(page) == {report}


def test_a_click_on_a_heading_sorts(page):
    psnr = heads(page).index("PSNR, dB")
    assert page.find_element(By.CSS_SELECTOR, '[aria-sort="descending"]').text == "PSNR, dB"
    values = [float(text) for text in column(page, psnr) if text != ABSENT]
    assert values == sorted(values, reverse=True)
    assert len(values) == 4
    page.find_element(By.CSS_SELECTOR, '[data-key="psnr"]').click()
    assert [float(text) for text in column(page, psnr) if text != ABSENT] == values[::-1]
    assert column(page, psnr)[-2:] == [ABSENT, ABSENT]
    page.switch_to.active_element.send_keys(Keys.ENTER)
    assert [float(text) for text in column(page, psnr)[:4]] == values


def test_filters_select_runs_and_mistakes_are_said(page, store):
    field = by_id(page, "filter")
    for text, count in (("field=qcolor seed<5", 2), ("state=failed,interrupted", 2), ("classical", 2), ("psnr>100", 0)):
        field.clear()
        field.send_keys(text)
        status = f"{count} of {count} selected" if count else "no run matches; there are 6"
        wait(page, lambda status=status: by_id(page, "page-status").text.endswith(status))
        assert len(rows(page)) == count
    field.clear()
    field.send_keys("colour=1L2S")
    wait(page, lambda: by_id(page, "filter-error").text.startswith("no run has a column colour"))
    field.clear()
    choose(page, "state", "failed")
    wait(page, lambda: len(rows(page)) == 1)
    assert column(page, heads(page).index("state")) == ["failed"]


def test_the_plot_draws_the_means_and_spreads_of_the_figures(page, store):
    table = capacity_points(prepared(runs(store))).set_index("field")
    traces = page.execute_script(
        "return document.getElementById('capacity').data.map((t) => [t.name, t.x, t.y, t.error_y?.array])"
    )
    drawn = {name: (x, y, spread) for name, x, y, spread in traces}
    for name in ("classical", "qcolor"):
        point = table.loc[name]
        (x,), (y,), (spread,) = drawn[name]
        assert (x, y, spread) == pytest.approx((point["params"], point["psnr"], point["psnr_std"]), rel=1e-3)
        assert len(drawn[f"{name}, runs"][0]) == 2


def test_a_click_on_a_mark_opens_its_run_and_escape_closes_it(page):
    place = page.execute_script("""
        const plot = document.getElementById('speed');
        plot.scrollIntoView({block: 'center', behavior: 'instant'});
        const trace = plot.data.findIndex((t) => t.name === 'qcolor');
        const point = plot.querySelectorAll('.scatterlayer .trace')[trace].querySelector('.point');
        const mark = point.getBoundingClientRect();
        return [mark.x + mark.width / 2, mark.y + mark.height / 2]""")
    for kind in ("mouseMoved", "mousePressed", "mouseReleased"):
        press = {} if kind == "mouseMoved" else {"button": "left", "clickCount": 1}
        page.execute_cdp_cmd("Input.dispatchMouseEvent", {"type": kind, "x": place[0], "y": place[1], **press})
    wait(page, lambda: by_id(page, "detail").get_attribute("open"))
    title = by_id(page, "detail-title").text
    assert "qcolor" in title
    assert title in page.current_url
    assert "color.qiren.layers" in by_id(page, "detail-body").text
    page.switch_to.active_element.send_keys(Keys.ESCAPE)
    wait(page, lambda: not by_id(page, "detail").get_attribute("open"))
    assert "#run=" not in page.current_url


def test_the_slider_moves_by_keys_and_shows_what_is_chosen(page):
    slider = by_id(page, "position")
    page.execute_script("arguments[0].scrollIntoView({block: 'center', behavior: 'instant'})", slider)
    sources = [by_id(page, f"{side}-image").get_attribute("src") for side in ("left", "right")]
    assert all(source.startswith("data:image/webp") for source in sources)
    assert sources[0] != sources[1]
    at = "return getComputedStyle(document.getElementById('slider')).getPropertyValue('--at')"
    assert page.execute_script(at) == "50%"
    slider.send_keys(Keys.ARROW_RIGHT * 10)
    assert page.execute_script(at) == "60%"
    choose(page, "left", "a")
    assert by_id(page, "left-image").get_attribute("src") == sources[1]
    choose(page, "right", "b")
    assert by_id(page, "right-image").get_attribute("src") not in sources
    assert by_id(page, "right-name").text == "B, render"
    by_id(page, "difference").click()
    blending = "return getComputedStyle(document.getElementById('right-image')).mixBlendMode"
    assert page.execute_script(blending) == "difference"


def test_two_runs_are_told_apart_by_their_settings(page):
    def compared():
        cells = [row.text for row in page.find_elements(By.CSS_SELECTOR, "#config-diff tbody tr")]
        return {line.split(" ")[0] for line in cells}

    assert {"color.name", "PSNR,"} <= compared()
    classical = page.find_elements(By.CSS_SELECTOR, '#runs-body input[name="side-a"]')
    names = column(page, 0)
    pair = [number for number, name in enumerate(names) if "classical" in name]
    classical[pair[0]].click()
    page.find_elements(By.CSS_SELECTOR, '#runs-body input[name="side-b"]')[pair[1]].click()
    assert "seed" in compared()
    assert "color.name" not in compared()
    assert by_id(page, "diff-status").text.startswith("1 of ")


def test_the_theme_follows_the_system_until_it_is_chosen(browser, report):
    paper = "return getComputedStyle(document.body).backgroundColor"
    opened(browser, report, scheme="light")
    light = browser.execute_script(paper)
    opened(browser, report, scheme="dark")
    dark = browser.execute_script(paper)
    assert light != dark
    button = by_id(browser, "theme")
    assert button.get_attribute("aria-pressed") == "true"
    button.click()
    assert browser.execute_script(paper) == light
    assert errors(browser) == []


@pytest.mark.parametrize("width", [390, 1280])
@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_nothing_sticks_out_sideways(browser, report, width, scheme):
    opened(browser, report, width, scheme)
    assert browser.execute_script("return innerWidth") == width
    assert overflow(browser) == 0
    browser.execute_script("location.hash = document.querySelector('#runs-body a').hash")
    wait(browser, lambda: by_id(browser, "detail").get_attribute("open"))
    assert overflow(browser) == 0
    assert errors(browser) == []


def test_tables_are_copied_as_latex(page):
    page.execute_script("navigator.clipboard.writeText = (text) => { window.copied = text; return Promise.resolve(); }")
    button = page.find_element(By.CSS_SELECTOR, "#tables [data-copy]")
    page.execute_script("arguments[0].scrollIntoView({block: 'center', behavior: 'instant'})", button)
    button.click()
    assert wait(page, lambda: page.execute_script("return window.copied")).startswith("\\begin{table}")


def test_a_store_where_nothing_finished_opens(browser, tmp_path):
    write_run(tmp_path / "runs", state="failed")
    (write_run(tmp_path / "runs", seed=1) / "summary.parquet").write_bytes(b"")
    main([str(tmp_path / "runs"), "--out", str(tmp_path / "page.html")])
    opened(browser, (tmp_path / "page.html").as_uri())
    assert sorted(column(browser, heads(browser).index("state"))) == ["damaged", "failed"]
    assert "no finished runs among 2" in by_id(browser, "plots-section").text
    assert errors(browser) == []


def test_hostile_texts_are_shown_and_not_run(browser, tmp_path):
    run = write_run(tmp_path / "runs", config={"experiment": EVIL, "scene": {"name": EVIL, "path": None}})
    run.rename(run.with_name("<img src=x onerror=alert(3)>"))
    main([str(tmp_path / "runs"), "--out", str(tmp_path / "evil.html"), "--title", EVIL])
    address = (tmp_path / "evil.html").as_uri()
    opened(browser, address)
    assert by_id(browser, "runs-title").text == "Runs"
    assert browser.find_element(By.TAG_NAME, "h1").text == EVIL
    browser.execute_script("location.hash = document.querySelector('#runs-body a').hash")
    wait(browser, lambda: EVIL in by_id(browser, "detail-body").text)
    assert browser.find_elements(By.CSS_SELECTOR, "img[src=x]") == []
    assert requested(browser) == {address}
    assert errors(browser) == []
