"""Debian's Chromium without a screen, for tests of pages; a module that imports this is skipped without it."""

import contextlib
import json
import shutil

import pytest

CHROMIUM, DRIVER = shutil.which("chromium"), shutil.which("chromedriver")
webdriver = pytest.importorskip("selenium.webdriver", reason="selenium is not installed")
if not (CHROMIUM and DRIVER):
    pytest.skip("chromium and chromedriver are not installed", allow_module_level=True)
from selenium.common.exceptions import StaleElementReferenceException  # noqa: E402
from selenium.webdriver.common.by import By  # noqa: E402
from selenium.webdriver.support.wait import WebDriverWait  # noqa: E402

ARGUMENTS = (
    "--headless",
    "--no-sandbox",
    "--disable-dev-shm-usage",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
)


@contextlib.contextmanager
def chromium(profile, *more):
    """A browser whose own files are in the folder `profile`; `more` arguments of its command."""
    options = webdriver.ChromeOptions()
    options.binary_location = CHROMIUM
    for argument in (*ARGUMENTS, *more, f"--user-data-dir={profile}"):
        options.add_argument(argument)
    options.set_capability("goog:loggingPrefs", {"browser": "ALL", "performance": "ALL"})
    driver = webdriver.Chrome(options=options, service=webdriver.ChromeService(DRIVER))
    try:
        yield driver
    finally:
        driver.quit()


def opened(browser, address, width=1280, scheme="light", *, plots=True):
    """Loads a page anew at this width (pixels) and preferred colour scheme."""
    size = {"width": width, "height": 900, "deviceScaleFactor": 1, "mobile": width < 600}
    browser.get("about:blank")
    browser.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", size)
    media = {"features": [{"name": "prefers-color-scheme", "value": scheme}]}
    browser.execute_cdp_cmd("Emulation.setEmulatedMedia", media)
    errors(browser)
    browser.get_log("performance")
    browser.get(address)
    if plots:  # they are drawn when they come near the screen
        browser.execute_script("document.getElementById('explore-section').scrollIntoView({behavior: 'instant'})")
        wait(browser, lambda: browser.find_elements(By.CSS_SELECTOR, "#scatter .xtitle"))
        browser.execute_script("scrollTo({top: 0, behavior: 'instant'})")


def errors(browser):
    """What the console has said since it was last asked: errors, and violations of the page's policy."""
    return [entry["message"] for entry in browser.get_log("browser")]


def requested(browser):
    events = (json.loads(entry["message"])["message"] for entry in browser.get_log("performance"))
    sent = [event for event in events if event["method"] == "Network.requestWillBeSent"]
    addresses = {event["params"]["request"]["url"] for event in sent}
    return {address for address in addresses if not address.startswith(("data:", "about:", "chrome:"))}


def wait(browser, condition):
    """The first true value of the condition, which is asked again if the page redraws what it reads."""
    waiting = WebDriverWait(browser, 30, ignored_exceptions=[StaleElementReferenceException])
    return waiting.until(lambda _: condition())


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
