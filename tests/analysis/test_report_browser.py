"""The page in a real browser: Debian's Chromium without a screen, with the page opened from disk."""

import pytest
from qnerf.analysis.report.__main__ import main
from selenium.webdriver.common.keys import Keys

from tests.helpers.browser import chromium
from tests.helpers.packed_stores import write_run

ABSENT = "\N{EN DASH}"
EVIL = "<img src=x onerror=alert(1)></script><script>alert(2)</script>"


@pytest.fixture(scope="module")
def report(trained, tmp_path_factory):
    out = tmp_path_factory.mktemp("page") / "index.html"
    main([str(trained), "--out", str(out)])
    return out.as_uri()


@pytest.fixture(scope="module")
def browser(tmp_path_factory):
    with chromium(tmp_path_factory.mktemp("chromium")) as driver:
        yield driver


@pytest.fixture
def page(browser, report):
    browser.opened(report)
    browser.execute_script("document.getElementById('runs-section').scrollIntoView({behavior: 'instant'})")
    yield browser
    assert browser.errors() == []


def test_a_click_on_a_heading_sorts(page):
    psnr = page.heads().index("PSNR, dB")
    assert page.one('[aria-sort="descending"]').text == "PSNR, dB"
    values = [float(text) for text in page.column(psnr) if text != ABSENT]
    assert values == sorted(values, reverse=True)
    assert len(values) == 4
    page.one('[data-key="psnr"]').click()
    assert [float(text) for text in page.column(psnr) if text != ABSENT] == values[::-1]
    assert page.column(psnr)[-2:] == [ABSENT, ABSENT]
    page.switch_to.active_element.send_keys(Keys.ENTER)
    assert [float(text) for text in page.column(psnr)[:4]] == values


def test_filters_select_runs_and_mistakes_are_said(page):
    field = page.by_id("filter")
    for text, count in (("field=qcolor seed<5", 2), ("state=failed,interrupted", 2), ("classical", 2), ("psnr>100", 0)):
        field.clear()
        field.send_keys(text)
        status = f"{count} of {count} selected" if count else "no run matches; there are 6"
        page.wait(lambda status=status: page.by_id("page-status").text.endswith(status))
        assert len(page.rows()) == count
    field.clear()
    field.send_keys("layers=2")
    page.wait(lambda: page.by_id("filter-error").text.startswith("no run has a column layers; did you mean "))
    field.clear()
    page.choose("state", "failed")
    page.wait(lambda: len(page.rows()) == 1)
    assert page.column(page.heads().index("state")) == ["failed out of memory"]


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
    page.wait(lambda: page.by_id("detail").get_attribute("open"))
    title = page.by_id("detail-title").text
    assert "qcolor" in title
    assert title in page.current_url
    assert "color.qiren.layers" in page.by_id("detail-body").text
    page.switch_to.active_element.send_keys(Keys.ESCAPE)
    page.wait(lambda: not page.by_id("detail").get_attribute("open"))
    assert "#run=" not in page.current_url


def test_the_slider_moves_by_keys_and_shows_what_is_chosen(page):
    slider = page.by_id("position")
    page.execute_script("arguments[0].scrollIntoView({block: 'center', behavior: 'instant'})", slider)
    page.wait(lambda: page.by_id("right-image").get_attribute("src"))
    sources = [page.by_id(f"{side}-image").get_attribute("src") for side in ("left", "right")]
    assert all(source.startswith("data:image/webp") for source in sources)
    assert sources[0] != sources[1]
    at = "return getComputedStyle(document.getElementById('slider')).getPropertyValue('--at')"
    assert page.execute_script(at) == "50%"
    slider.send_keys(Keys.ARROW_RIGHT * 10)
    assert page.execute_script(at) == "60%"
    page.choose("left", "0:render")
    assert page.by_id("left-image").get_attribute("src") == sources[1]
    page.choose("right", "1:render")
    assert page.by_id("right-image").get_attribute("src") not in sources
    assert page.by_id("right-name").text == "B, render"
    page.by_id("difference").click()
    blending = "return getComputedStyle(document.getElementById('right-image')).mixBlendMode"
    assert page.execute_script(blending) == "difference"


def test_runs_that_are_ticked_are_told_apart_by_their_settings(page):
    def different():
        return {row.get_attribute("textContent") for row in page.all("#config-diff tbody th")}

    page.execute_script("document.getElementById('compared-section').scrollIntoView({behavior: 'instant'})")
    page.wait(lambda: {"color.name", "PSNR, dB"} <= different())
    boxes = page.all("#runs-body input")
    ticked = {box.get_attribute("aria-label"): box.is_selected() for box in boxes}
    for label, is_ticked in ticked.items():
        if is_ticked != ("classical" in label):
            page.one(f'#runs-body [aria-label="{label}"]').send_keys(Keys.SPACE)
    page.wait(lambda: "seed" in different() and "color.name" not in different())
    assert page.by_id("diff-status").text.startswith("1 of ")
    page.wait(lambda: len(page.all("#grid tbody tr")) == 3)
    assert len(page.all("#chosen li")) == 2


def test_the_view_comes_back_from_its_address(browser, page, report):
    page.by_id("filter").send_keys("field=qcolor")
    page.wait(lambda: len(page.rows()) == 4)  # the table is made anew when typing pauses
    page.one('[data-key="seed"]').click()
    page.one("#columns summary").click()
    page.by_id("column-search").send_keys("train.steps")
    page.wait(lambda: len(page.all("#column-boxes input")) == 1)
    page.one("#column-boxes input").click()
    page.choose("curve-by", "seed")
    address = page.current_url
    browser.opened(address)
    assert len(page.rows()) == 4
    assert page.one('[aria-sort="descending"]').text == "seed"
    assert page.heads()[-1] == "train.steps"
    assert page.by_id("curve-by").get_attribute("value") == "seed"
    written = page.execute_script("return tableAsCsv()").splitlines()
    assert written[0].startswith("run_id,psnr,state")
    assert len(written) == 5
    assert page.execute_script("return csv([['=1', -1, 'a,b', null]])") == '=1,-1,"a,b",\n'


def test_means_and_bands_are_those_of_the_runs(page):
    page.execute_script("document.getElementById('curves-section').scrollIntoView({behavior: 'instant'})")
    page.choose("curve-key", "train/psnr")
    page.choose("curve-by", "field")
    page.wait(lambda: len(page.execute_script("return document.getElementById('curves-plot').data ?? []")) == 4)
    lines = page.execute_script("return document.getElementById('curves-plot').data.map((t) => [t.name, t.y])")
    means = {name.split(" ")[0]: y for name, y in lines if name}
    logged = page.execute_script("""
        const all = [...Array(DATA.total).keys()].filter((run) => value("field", run) === "qcolor");
        return all.filter((run) => DATA.curves[run]).map((run) => DATA.curves[run]["train/psnr"].value)""")
    assert means["qcolor"] == pytest.approx([sum(values) / 2 for values in zip(*logged, strict=True)])


def test_the_theme_follows_the_system(browser, report):
    papers = set()
    for scheme in ("light", "dark"):
        browser.opened(report, scheme=scheme)
        papers.add(browser.execute_script("return getComputedStyle(document.body).backgroundColor"))
    assert len(papers) == 2
    assert browser.errors() == []


@pytest.mark.parametrize(("width", "scheme"), [(390, "light"), (1280, "dark")])
def test_report_does_not_stick_out_sideways(browser, report, width, scheme):
    browser.opened(report, width, scheme)
    assert browser.execute_script("return innerWidth") == width
    assert browser.overflow() == 0
    browser.execute_script("location.hash = document.querySelector('#runs-body a').hash")
    browser.wait(lambda: browser.by_id("detail").get_attribute("open"))
    assert browser.overflow() == 0
    assert browser.errors() == []


def test_tables_are_copied_as_latex(page):
    page.execute_script("navigator.clipboard.writeText = (text) => { window.copied = text; return Promise.resolve(); }")
    button = page.one("#tables [data-copy]")
    page.execute_script("arguments[0].scrollIntoView({block: 'center', behavior: 'instant'})", button)
    button.click()
    assert page.wait(lambda: page.execute_script("return window.copied")).startswith("\\begin{table}")


def test_hostile_texts_are_shown_and_not_run(browser, tmp_path):
    run = write_run(tmp_path / "runs", config={"experiment": EVIL, "scene": {"name": EVIL, "path": None}})
    run.rename(run.with_name("<img src=x onerror=alert(3)>"))
    main([str(tmp_path / "runs"), "--out", str(tmp_path / "evil.html"), "--title", EVIL])
    address = (tmp_path / "evil.html").as_uri()
    browser.opened(address)
    assert browser.by_id("runs-title").text == "Runs"
    assert browser.one("h1").text == EVIL
    browser.execute_script("location.hash = document.querySelector('#runs-body a').hash")
    browser.wait(lambda: EVIL in browser.by_id("detail-body").text)
    assert browser.all("img[src=x]") == []
    assert browser.requested() == {address}
    assert browser.errors() == []
