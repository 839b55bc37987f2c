"""The examples in docstrings show what really happens."""

import doctest
import importlib

from tests.helpers.configs import ROOT

PACKAGE = ROOT / "src" / "qnerf"
FILES = [(path, PACKAGE) for path in PACKAGE.rglob("*.py")]
FILES += [(path, ROOT) for path in (ROOT / "analysis").rglob("*.py")]
MODULES = sorted(
    ".".join(("qnerf", *path.relative_to(base).with_suffix("").parts)).removesuffix(".__init__")
    for path, base in FILES
    if ">>> " in path.read_text()
)


def test_the_examples_of_a_module_hold():
    for name in MODULES:
        module = importlib.import_module(name)
        result = doctest.testmod(module, optionflags=doctest.ELLIPSIS | doctest.NORMALIZE_WHITESPACE)
        assert result.attempted, f"{name}: the examples are where doctest does not look, such as a compiled function"
        assert not result.failed, name
