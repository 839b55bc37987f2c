"""A config.yaml of another person: read as plain values, or refused in one line."""

from pathlib import Path

import pytest

from qnerf import records
from qnerf.records import StoreError
from tests.helpers.spoiled import interrupted, store

BOMB = "a: &a [x, x, x, x, x, x, x, x, x]\n" + "".join(
    f"{chr(98 + i)}: &{chr(98 + i)} [{', '.join([f'*{chr(97 + i)}'] * 9)}]\n" for i in range(9)
)
"""Billion laughs: nine levels of nine aliases each."""

HOSTILE = {
    "apply": "a: !!python/object/apply:os.system ['touch OWNED']\n",
    "new": "a: !!python/object/new:subprocess.Popen [['touch', 'OWNED']]\n",
    "name": "a: !!python/name:os.system\n",
    "tuple": "a: !!python/tuple [1, 2]\n",
    "own tag": "a: !Path /etc/passwd\n",
    "bomb": BOMB,
    "alias": "a: &x 1\nb: *x\n",
    "deep": "a: " + "[" * 5_000,
    "digits": "a: " + "9" * 5_000 + "\n",
    "list": "[1, 2]\n",
    "text": "hello\n",
    "empty": "",
    "binary": "\x00\x01",
    "bytes": "a: \udcff\n",
    "large": "a: " + "x" * 2**18 + "\n",
}


@pytest.mark.parametrize("text", HOSTILE.values(), ids=HOSTILE)
def test_hostile_yaml_is_refused_in_one_line(tmp_path: Path, text: str) -> None:
    run = interrupted(tmp_path)
    data = text.replace("OWNED", str(tmp_path / "owned")).encode(errors="surrogateescape")
    (run / "config.yaml").write_bytes(data)
    with pytest.raises(StoreError, match=r"config\.yaml: ") as error:
        records.read_config(run)
    assert "\n" not in str(error.value)
    assert not (tmp_path / "owned").exists()


def test_a_run_with_a_hostile_configuration_goes_on_with_one_s_own(tmp_path: Path) -> None:
    run = interrupted(tmp_path)
    (run / "config.yaml").write_text(HOSTILE["bomb"])
    claim = store(tmp_path).claim("a", {"seed": 1})
    assert claim.run is not None
    assert claim.run.config == {"seed": 1}
    claim.run.finish()


def test_a_date_is_text(tmp_path: Path) -> None:
    """As Hydra takes it; a table has no room for more kinds of values."""
    run = interrupted(tmp_path)
    (run / "config.yaml").write_text("a: 2001-01-01\nb: 2001-99-99\n")
    assert records.read_config(run) == {"a": "2001-01-01", "b": "2001-99-99"}


def test_text_that_looks_like_more_stays_text(tmp_path: Path) -> None:
    """What hostile values a configuration may hold, as values: written and read back as they are."""
    config = {"a": "!!python/object/apply:os.system ['x']", "b": "*a", "c": "&a 1", "d": "<<", "e\n": "\x1b[2J"}
    claim = store(tmp_path).claim("a", config)
    assert claim.run is not None
    assert records.read_config(claim.dir) == config
    claim.run.finish()
