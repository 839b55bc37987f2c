"""Debian's Chromium without a screen, for tests of pages; a module that imports this is skipped without it."""

import contextlib
import json
import shutil

import pytest
from selenium import webdriver
from selenium.common.exceptions import StaleElementReferenceException
from selenium.webdriver.common.by import By
from selenium.webdriver.support.wait import WebDriverWait

CHROMIUM, DRIVER = shutil.which("chromium"), shutil.which("chromedriver")
if not (CHROMIUM and DRIVER):
    pytest.skip("chromium and chromedriver are not installed", allow_module_level=True)

ARGUMENTS = (
    "--headless",
    "--no-sandbox",
    "--disable-dev-shm-usage",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
)


class Browser(webdriver.Chrome):
    """Chromium with a page of runs in it."""

    def opened(self, address, width=1280, scheme="light", *, plots=True):
        """Loads a page anew at this width (pixels) and preferred colour scheme."""
        size = {"width": width, "height": 900, "deviceScaleFactor": 1, "mobile": width < 600}
        self.get("about:blank")
        self.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", size)
        media = {"features": [{"name": "prefers-color-scheme", "value": scheme}]}
        self.execute_cdp_cmd("Emulation.setEmulatedMedia", media)
        self.errors()
        self.get_log("performance")
        self.get(address)
        if plots:  # they are drawn when they come near the screen
            self.execute_script("document.getElementById('explore-section').scrollIntoView({behavior: 'instant'})")
            self.wait(lambda: self.all("#scatter .xtitle"))
            self.execute_script("scrollTo({top: 0, behavior: 'instant'})")

    def errors(self):
        """What the console has said since it was last asked: errors, and violations of the page's policy."""
        return [entry["message"] for entry in self.get_log("browser")]

    def requested(self):
        events = (json.loads(entry["message"])["message"] for entry in self.get_log("performance"))
        sent = [event for event in events if event["method"] == "Network.requestWillBeSent"]
        addresses = {event["params"]["request"]["url"] for event in sent}
        return {address for address in addresses if not address.startswith(("data:", "about:", "chrome:"))}

    def wait(self, condition):
        """The first true value of the condition, which is asked again if the page redraws what it reads."""
        waiting = WebDriverWait(self, 30, ignored_exceptions=[StaleElementReferenceException])
        return waiting.until(lambda _: condition())

    def by_id(self, name):
        return self.find_element(By.ID, name)

    def column(self, number):
        """Texts of a column of the table of runs; 0 is the name."""
        return [row.find_elements(By.CSS_SELECTOR, "th, td")[number].text for row in self.rows()]

    def rows(self):
        return self.all("#runs-body tr")

    def heads(self):
        return [cell.text.split("\n")[0] for cell in self.all("#runs-head th")]

    def choose(self, name, choice):
        script = "arguments[0].value = arguments[1]; arguments[0].dispatchEvent(new Event('change'))"
        self.execute_script(script, self.by_id(name), choice)

    def overflow(self):
        return self.execute_script("return document.documentElement.scrollWidth - document.documentElement.clientWidth")

    def one(self, selector):
        return self.find_element(By.CSS_SELECTOR, selector)

    def all(self, selector):
        return self.find_elements(By.CSS_SELECTOR, selector)


@contextlib.contextmanager
def chromium(profile, *more):
    """A browser whose own files are in the folder `profile`; `more` arguments of its command."""
    options = webdriver.ChromeOptions()
    options.binary_location = CHROMIUM
    for argument in (*ARGUMENTS, *more, f"--user-data-dir={profile}"):
        options.add_argument(argument)
    options.set_capability("goog:loggingPrefs", {"browser": "ALL", "performance": "ALL"})
    with Browser(options=options, service=webdriver.ChromeService(DRIVER)) as driver:
        yield driver
