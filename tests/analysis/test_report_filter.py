"""The filter on the report's page chooses the runs that `qnerf runs` chooses."""

import json
import shutil
import subprocess
from pathlib import Path

import pandas as pd
import pytest
from qnerf.analysis.report import content

from qnerf.records import filters

pytestmark = pytest.mark.skipif(not shutil.which("node"), reason="node is not installed")

RUNS = {
    "run_id": ["poster-a-s0", "poster-b-s1", "fox-c-s0", "[odd] id"],
    "state": ["finished", "failed", "finished", None],
    "psnr": [25.0, None, 21.5, -1e-3],
    "seed": [0, 1, 0, 10],
    "flag": [True, False, None, True],
    "tags": [["good", "base"], None, ["base"], None],
    "mixed": ["10.0", "auto", "true", "a,b"],
    "two words": ["x y", "x", None, "none"],
    "samples": ["[128, 64]", "[64]", None, "[1,2"],
    "scene.path": [None, "/data/a[1]", "/data/fox_64", "/data/b?"],
}
CONDITIONS = [
    "", "poster", "poster s0", "id=fox-*", "[odd]", "state=finished,failed", "state!=finished", "state=none",
    "psnr>21.5", "psnr>=21.5", "psnr<0", "psnr<=2.5e1", "psnr=25", "psnr=25.0", "psnr=none", "psnr!=none", "psnr<inf",
    "psnr>-inf", "psnr=+.25e2", "seed=0,10", "seed=1_0", "seed=", "seed=0x0", "flag=true", "flag=TRUE", "flag>0",
    "flag=1", "flag=none", "tag=good", "tags=base", "tag=none", "tag!=base", "mixed=10", "mixed=au*", "mixed=a?b",
    "'two words=x y'", "'two words'=x*", '"two words"=none', "two\\ words=x", "psnr>1\\", "scene.path=*a[1]",
    "scene.path=/data/?*", "scene.path=*[!x]*", "field=1", "state=finished,seed=0", "seed=0,1,psnr>22",
    "psnr>high", "psnr<", "state='open",
    "seed=0  state=finished", "run_id=[odd]*", "psnr=nan", "mixed=a,b", "! =", "=x", ",seed=0",
    "samples=[128,64]", "'samples=[128, 64]'", "samples=[64],[128,64]", "samples!=[64]", "samples=[128,64],seed=0",
    "samples=[1,2", "samples=[*",
]  # fmt: skip

PROGRAM = """
const columns = new Map(Object.entries(RUNS));
const value = (name, run) => columns.get(name)?.[run] ?? null;
const chosen = CONDITIONS.map((text) => {
  try { const meets = parseFilter(text); return [...RUNS.run_id.keys()].filter(meets); } catch { return null; }
});
console.log(JSON.stringify(chosen));
"""


def in_python(text: str) -> list[int] | None:
    frame = pd.DataFrame({name: pd.Series(values, dtype=object) for name, values in RUNS.items()})
    try:
        return filters.select(frame, filters.parse(text)).index.tolist()
    except ValueError:
        return None


def test_both_languages_choose_the_same_runs() -> None:
    code = (Path(content.__file__).with_name("filter.js")).read_text(encoding="utf-8")
    data = f"const RUNS = {json.dumps(RUNS)}; const CONDITIONS = {json.dumps(CONDITIONS)};"
    done = subprocess.run(["node", "-e", data + code + PROGRAM], capture_output=True, text=True, check=True)
    on_the_page = dict(zip(CONDITIONS, json.loads(done.stdout), strict=True))
    assert on_the_page == {text: in_python(text) for text in CONDITIONS}
    assert on_the_page["psnr>21.5"] == [0]
    assert on_the_page["psnr>high"] is None
    assert on_the_page["samples=[64],[128,64]"] == [0, 1]
