"""The page in a real browser: Debian's Chromium without a screen, with the page opened from disk."""

import pytest
from qnerf.analysis.report.__main__ import main

from tests.helpers.browser import (
    by_id,
    choose,
    chromium,
    column,
    errors,
    heads,
    opened,
    overflow,
    requested,
    rows,
    wait,
)
from tests.helpers.packed_stores import write_run
from tests.helpers.sweep import sweep

By = pytest.importorskip("selenium.webdriver.common.by", reason="selenium is not installed").By
Keys = pytest.importorskip("selenium.webdriver.common.keys", reason="selenium is not installed").Keys
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
    with chromium(tmp_path_factory.mktemp("chromium")) as driver:
        yield driver


@pytest.fixture
def page(browser, report):
    opened(browser, report)
    yield browser
    assert errors(browser) == []


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
    assert column(page, heads(page).index("state")) == ["failed out of memory"]


def test_a_click_on_a_mark_opens_its_run_and_escape_closes_it(page):
    place = page.execute_script("""
        const plot = document.getElementById('scatter');
        plot.scrollIntoView({block: 'center', behavior: 'instant'});
        const place = plot.data[0].customdata.findIndex((run) => value('field', run) === 'qcolor');
        const mark = plot.querySelectorAll('.scatterlayer .point')[place].getBoundingClientRect();
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
    wait(page, lambda: by_id(page, "right-image").get_attribute("src"))
    sources = [by_id(page, f"{side}-image").get_attribute("src") for side in ("left", "right")]
    assert all(source.startswith("data:image/webp") for source in sources)
    assert sources[0] != sources[1]
    at = "return getComputedStyle(document.getElementById('slider')).getPropertyValue('--at')"
    assert page.execute_script(at) == "50%"
    slider.send_keys(Keys.ARROW_RIGHT * 10)
    assert page.execute_script(at) == "60%"
    choose(page, "left", "0:render")
    assert by_id(page, "left-image").get_attribute("src") == sources[1]
    choose(page, "right", "1:render")
    assert by_id(page, "right-image").get_attribute("src") not in sources
    assert by_id(page, "right-name").text == "B, render"
    by_id(page, "difference").click()
    blending = "return getComputedStyle(document.getElementById('right-image')).mixBlendMode"
    assert page.execute_script(blending) == "difference"


def test_runs_that_are_ticked_are_told_apart_by_their_settings(page):
    def different():
        return {
            row.get_attribute("textContent") for row in page.find_elements(By.CSS_SELECTOR, "#config-diff tbody th")
        }

    page.execute_script("document.getElementById('compared-section').scrollIntoView({behavior: 'instant'})")
    wait(page, lambda: {"color.name", "PSNR, dB"} <= different())
    boxes = page.find_elements(By.CSS_SELECTOR, "#runs-body input")
    ticked = {box.get_attribute("aria-label"): box.is_selected() for box in boxes}
    for label, is_ticked in ticked.items():
        if is_ticked != ("classical" in label):
            page.find_element(By.CSS_SELECTOR, f'#runs-body [aria-label="{label}"]').send_keys(Keys.SPACE)
    wait(page, lambda: "seed" in different() and "color.name" not in different())
    assert by_id(page, "diff-status").text.startswith("1 of ")
    wait(page, lambda: len(page.find_elements(By.CSS_SELECTOR, "#grid tbody tr")) == 3)
    assert len(page.find_elements(By.CSS_SELECTOR, "#chosen li")) == 2


def test_the_view_comes_back_from_its_address(browser, page, report):
    by_id(page, "filter").send_keys("field=qcolor")
    wait(page, lambda: len(rows(page)) == 4)  # the table is made anew when typing pauses
    page.find_element(By.CSS_SELECTOR, '[data-key="seed"]').click()
    by_id(page, "columns").find_element(By.TAG_NAME, "summary").click()
    by_id(page, "column-search").send_keys("train.steps")
    wait(page, lambda: len(page.find_elements(By.CSS_SELECTOR, "#column-boxes input")) == 1)
    page.find_element(By.CSS_SELECTOR, "#column-boxes input").click()
    choose(page, "curve-by", "seed")
    address = page.current_url
    opened(browser, address)
    assert len(rows(page)) == 4
    assert page.find_element(By.CSS_SELECTOR, '[aria-sort="descending"]').text == "seed"
    assert heads(page)[-1] == "train.steps"
    assert by_id(page, "curve-by").get_attribute("value") == "seed"
    written = page.execute_script("return tableAsCsv()").splitlines()
    assert written[0].startswith("run_id,psnr,state")
    assert len(written) == 5
    assert page.execute_script("return csv([['=1', -1, 'a,b', null]])") == '=1,-1,"a,b",\n'


def test_means_and_bands_are_those_of_the_runs(page):
    page.execute_script("document.getElementById('curves-section').scrollIntoView({behavior: 'instant'})")
    choose(page, "curve-key", "train/psnr")
    by_id(page, "curve-mean").click()
    wait(page, lambda: len(page.execute_script("return document.getElementById('curves-plot').data ?? []")) == 4)
    lines = page.execute_script("return document.getElementById('curves-plot').data.map((t) => [t.name, t.y])")
    means = {name.split(" ")[0]: y for name, y in lines if name}
    logged = page.execute_script("""
        const all = [...Array(DATA.total).keys()].filter((run) => value("field", run) === "qcolor");
        return all.filter((run) => DATA.curves[run]).map((run) => DATA.curves[run]["train/psnr"].value)""")
    assert means["qcolor"] == pytest.approx([sum(values) / 2 for values in zip(*logged, strict=True)])


def test_the_theme_follows_the_system(browser, report):
    papers = set()
    for scheme in ("light", "dark"):
        opened(browser, report, scheme=scheme)
        papers.add(browser.execute_script("return getComputedStyle(document.body).backgroundColor"))
    assert len(papers) == 2
    assert errors(browser) == []


@pytest.mark.parametrize(("width", "scheme"), [(390, "light"), (1280, "dark")])
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
