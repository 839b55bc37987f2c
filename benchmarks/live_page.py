"""How soon the live page shows a large store, and what is new in it: `python -m benchmarks.live_page STORE`.

A headless Chromium opens `qnerf serve STORE` and notes when the first rows of the table are there. Then a new run logs
a value every few seconds, and the page is watched until it shows it. STORE is filled to `--runs` runs first. With
`--mlflow-python`, the same runs are written into MLflow, and its server's page of runs is opened, too. Needs chromium,
chromedriver and Selenium. Prints a table of medians and maxima, and saves it as benchmarks/results/live_page.parquet.
"""

import argparse
import contextlib
import os
import shutil
import socket
import subprocess
import sys
import tempfile
import time
import urllib.error
import urllib.request
from collections.abc import Callable, Iterator
from pathlib import Path
from statistics import median
from typing import Any

import pandas as pd
from selenium import webdriver

from benchmarks.many_runs import generate
from benchmarks.tracking_mlflow import mlflow, write_lines
from qnerf.records import RunStore

RESULTS = Path(__file__).parent / "results"
ARGUMENTS = ("--headless", "--no-sandbox", "--disable-gpu", "--disable-dev-shm-usage", "--window-size=1280,900")
# Notes when the selector first matches, in milliseconds since the navigation began.
WATCH = """
const look = () => document.querySelector(%r) ? (window.__first = performance.now()) : requestAnimationFrame(look)
look()
"""
ROWS = "#runs-body tr"
MLFLOW_ROWS = ".ag-center-cols-container .ag-row"
MLFLOW_PAGE = "/#/experiments/0/runs?workflowType=machine_learning"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("store", help="folder of the runs; made where it is not there")
    parser.add_argument("--runs", type=int, default=10_000)
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--mlflow-python", metavar="PYTHON", help="python of an environment that has MLflow")
    parser.add_argument("--mlflow-database", type=Path, help="SQLite file, filled first (default: beside the store)")
    options = parser.parse_args()
    generate(options.store, options.runs)
    rows: list[dict[str, Any]] = []

    def add(tool: str, what: str, seconds: list[float], runs: int) -> None:
        rows.append({"tool": tool, "what": what, "median, s": median(seconds), "worst, s": max(seconds), "runs": runs})

    runs = len(RunStore(options.store).runs())
    command = [sys.executable, "-m", "qnerf.analysis.serve", options.store, "--port"]
    with served(command) as address:
        add("qnerf", "first rows", first_rows(address, options.repeats), runs)
        add("qnerf", "a new value", news(options.store, address, options.repeats), runs)
    if options.mlflow_python:
        database = options.mlflow_database or Path(options.store).with_suffix(".mlflow.db")
        lines = database.with_suffix(".json")
        runs = write_lines(options.store, lines)
        mlflow(options.mlflow_python, "write", database, "--runs", str(lines))
        server = [options.mlflow_python, "-m", "mlflow", "server", "--workers", "1"]
        with served([*server, "--backend-store-uri", f"sqlite:///{database.absolute()}", "--port"]) as address:
            add("MLflow", "first rows", first_rows(address + MLFLOW_PAGE, options.repeats, MLFLOW_ROWS), runs)
    table = pd.DataFrame(rows).assign(load=os.getloadavg()[0], cores=os.cpu_count())
    table.to_parquet(RESULTS / "live_page.parquet", index=False)
    print(table.to_string(index=False, float_format=lambda value: f"{value:.2f}"))


@contextlib.contextmanager
def served(command: list[str]) -> Iterator[str]:
    """Starts a server on a free port: its address, once it answers."""
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = free.getsockname()[1]
    address = f"http://127.0.0.1:{port}"
    process = subprocess.Popen([*command, str(port)], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    try:
        wait(lambda: answers(address) or process.poll() is not None)
        if process.poll() is not None:
            raise ValueError(f"it ended: {' '.join(command)}")
        yield address
    finally:
        process.terminate()
        process.wait()


def answers(address: str) -> bool:
    try:
        with urllib.request.urlopen(address, timeout=60) as answer:
            return bool(answer.status == 200)
    except (urllib.error.URLError, ConnectionError):
        return False


def wait(condition: Callable[[], Any], seconds: float = 120) -> None:
    end = time.monotonic() + seconds
    while not condition():
        if time.monotonic() > end:
            raise TimeoutError(f"nothing for {seconds} s")
        time.sleep(0.01)


@contextlib.contextmanager
def browser() -> Iterator[webdriver.Chrome]:
    """A Chromium that has cached nothing."""
    options = webdriver.ChromeOptions()
    options.binary_location = str(shutil.which("chromium"))
    with tempfile.TemporaryDirectory() as profile:
        for argument in (*ARGUMENTS, f"--user-data-dir={profile}"):
            options.add_argument(argument)
        driver = webdriver.Chrome(options=options, service=webdriver.ChromeService(shutil.which("chromedriver")))
        try:
            yield driver
        finally:
            driver.quit()


def first_rows(address: str, repeats: int, rows: str = ROWS) -> list[float]:
    """Seconds from opening the address to the first row, in a new browser each time."""
    found = []
    for _ in range(repeats):
        with browser() as driver:
            driver.execute_cdp_cmd("Page.addScriptToEvaluateOnNewDocument", {"source": WATCH % rows})
            driver.get(address)
            wait(lambda: driver.execute_script("return window.__first"))
            found.append(driver.execute_script("return window.__first") / 1000)
    return found


def news(store: str, address: str, repeats: int) -> list[float]:
    """Seconds from writing a value of a run in training to its text on the page."""
    claim = RunStore(store).claim(f"news-{time.time_ns()}", {"seed": 0, "train": {"steps": 100}})
    assert claim.run is not None
    found = []
    with browser() as driver:
        driver.get(address)
        for step in range(1, repeats + 1):
            value = 10 + step / 100
            claim.run.log(step, 0.1 * step, {"eval/psnr": value})
            claim.run.flush()
            claim.run.status(step=step)  # as with each heartbeat
            start = time.monotonic()
            shown = f"return document.getElementById('training').textContent.includes('{value:.2f}')"
            wait(lambda: driver.execute_script(shown))  # noqa: B023
            found.append(time.monotonic() - start)
            time.sleep(2.3)  # so that the page's looks come at any moment after a value
    claim.run.finish({"psnr": 10.0})
    shutil.rmtree(claim.run.dir)
    return found


if __name__ == "__main__":
    main()
