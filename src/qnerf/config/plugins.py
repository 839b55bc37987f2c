"""User modules that register components when they are imported."""

import importlib
import traceback
from collections.abc import Sequence

_imported: set[str] = set()


def import_plugins(names: Sequence[str]) -> None:
    """Imports the modules; ValueError names one that is missing, or that is no name of a module."""
    for name in names:
        if not all(part.isidentifier() for part in name.split(".")):
            raise ValueError(f"plugins: expected names of modules such as my_module or package.module, got {name!r}")
        _imported.add(name)
        try:
            importlib.import_module(name)
        except ModuleNotFoundError as error:
            if error.name is None or not f"{name}.".startswith(f"{error.name}."):
                raise ValueError(f"plugins: {name} imports {error.name}, which is not installed here") from error
            raise ValueError(
                f"plugins: no module {name!r}; expected {name.replace('.', '/')}.py in the current folder, or an "
                "installed module"
            ) from error


def raised_in(error: BaseException | None) -> str:
    """The innermost place in a user's module that led to the error, `my_module.Mine.forward, line 14`; else nothing."""
    place = ""
    while error is not None:
        for frame, line in traceback.walk_tb(error.__traceback__):
            module = frame.f_globals.get("__name__", "")
            if any(f"{module}.".startswith(f"{name}.") for name in _imported):
                place = f"{module}.{frame.f_code.co_qualname}, line {line}"
        error = error.__cause__
    return place


def check_plugins(run: object, stored: object, repeated: Sequence[str]) -> None:
    """ValueError unless the user repeats the plugins of a stored run.

    Its folder may come from anybody, and importing a module executes it.
    """
    names = [str(name) for name in stored] if isinstance(stored, list) else [str(stored)]
    if sorted(names) != sorted(repeated):
        listed = f"plugins=[{','.join(names)}]"
        advice = f"repeat {listed} on the command line to import them" if names else "leave plugins out"
        raise ValueError(f"{run}: was trained with {listed if names else 'no plugins'}; {advice}")
