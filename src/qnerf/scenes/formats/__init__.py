"""Readers of posed images. Each module registers one format; a new one is a module and its conf/scene/NAME.yaml."""

import importlib
import pkgutil

for _module in pkgutil.iter_modules(__path__, f"{__name__}."):
    importlib.import_module(_module.name)
