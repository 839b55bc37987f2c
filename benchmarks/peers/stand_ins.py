"""Empty stand-ins for packages that peers import but do not use where we run them.

With them nerfstudio's models can be imported without a display, CUDA or a full installation: viewers, images and
rasterisers are missing.
"""

import importlib.abc
import importlib.machinery
import importlib.util
import sys
from collections.abc import Sequence
from types import ModuleType
from typing import Any

# Its PSNR of each step and its LPIPS are not used, and the latter needs a download.
ALWAYS = ("torchmetrics",)
IF_MISSING = ("boto3", "cv2", "gsplat", "matplotlib", "mediapy", "nerfacc", "torchvision", "viser")


class _Nothing(type):
    """Of classes whose every other attribute is None."""

    def __getattr__(cls, name: str) -> None:
        if name.startswith("__"):
            raise AttributeError(name)


class _Empty(ModuleType):
    """A module in which every name is a class that takes any arguments and does nothing."""

    __path__: list[str] = []  # noqa: RUF012 (the type that modules declare)
    __file__ = "stand-in"  # "" reads as a module built into Python, which has no source

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):
            raise AttributeError(name)
        nothing = _Nothing(name, (), {"__init__": _ignore, "__call__": _ignore})
        setattr(self, name, nothing)
        return nothing


def _ignore(*_arguments: object, **_options: object) -> None:
    return None


class _Finder(importlib.abc.MetaPathFinder, importlib.abc.Loader):
    def __init__(self, packages: Sequence[str]) -> None:
        self.packages = packages

    def find_spec(self, fullname: str, path: object = None, target: object = None) -> Any:
        if fullname.split(".")[0] in self.packages:
            return importlib.machinery.ModuleSpec(fullname, self, is_package=True)
        return None

    def create_module(self, spec: importlib.machinery.ModuleSpec) -> ModuleType:
        return _Empty(spec.name)

    def exec_module(self, module: ModuleType) -> None: ...


def install(always: Sequence[str] = ALWAYS, if_missing: Sequence[str] = IF_MISSING) -> None:
    """Makes the packages importable, by default those of nerfstudio. Call it before the peer is imported."""
    missing = [name for name in if_missing if importlib.util.find_spec(name) is None]
    sys.meta_path.insert(0, _Finder([*always, *missing]))
