"""Name -> component. A component's keyword-only parameters are its options: the signature is the schema."""

import functools
import inspect
from collections.abc import Callable, Iterator, Mapping
from typing import Any, Generic, TypeVar, get_type_hints

from qnerf.config import bounds

T = TypeVar("T")


class Registry(Generic[T]):
    """The components of one config group.

    A component's positional parameters are wiring (dimensions, neighbours): the code that builds it passes them. Its
    keyword-only parameters are options: the user's configuration sets them. A class whose `__init__` takes `**options`
    and passes them on also has the options of its base class.

    >>> ENCODERS = Registry("encoder")
    >>> @ENCODERS.register("identity")
    ... class Identity:
    ...     def __init__(self, in_dim: int, *, scale: float = 1.0): ...
    >>> type(ENCODERS.build("identity", 3, scale=2.0)).__name__
    'Identity'
    >>> ENCODERS.build("identity", 3, scle=2.0)
    Traceback (most recent call last):
        ...
    ValueError: encoder=identity: unknown option scle=2.0; known: scale
    """

    def __init__(self, group: str) -> None:
        self.group = group
        self._components: dict[str, Callable[..., T]] = {}

    def register(self, name: str) -> Callable[[Callable[..., T]], Callable[..., T]]:
        def add(component: Callable[..., T]) -> Callable[..., T]:
            if name in self._components:
                raise ValueError(f"{self.group}={name}: the name is taken by {self._components[name].__module__}")
            self._components[name] = component
            return component

        return add

    def names(self) -> list[str]:
        return sorted(self._components)

    def get(self, name: str) -> Callable[..., T]:
        """The component registered under `name`; ValueError lists the known names."""
        if not isinstance(name, str) or name not in self._components:
            raise ValueError(f"{self.group}: unknown name {name!r}; known: {', '.join(self.names())}")
        return self._components[name]

    def name_of(self, component: Any) -> str | None:
        """The name under which exactly this component is registered."""
        return next((name for name, known in self._components.items() if known is component), None)

    def options(self, name: str) -> dict[str, inspect.Parameter]:
        """The keyword-only parameters of the component: what a user may set."""
        return {option: parameter for option, (parameter, _) in options_of(self.get(name)).items()}

    def build(self, name: str, /, *wiring: Any, **options: Any) -> T:
        """Builds the component; ValueError names the group, the option, its value and what was expected."""
        self.check(name, options)
        missing = [
            option
            for option, (parameter, _) in options_of(self.get(name)).items()
            if parameter.default is parameter.empty and option not in options
        ]
        if missing:
            raise ValueError(f"{self.group}={name}: missing {', '.join(missing)}")
        return self.build_checked(name, *wiring, **options)

    def build_checked(self, name: str, /, *wiring: Any, **options: Any) -> T:
        """`build` with options that have been checked, as those of a `building.configuration.Configuration`."""
        try:
            return self.get(name)(*wiring, **options)
        except ValueError as error:
            if str(error).startswith(self.group):
                raise
            raise ValueError(f"{self.group}={name}: {error}") from error

    def check(self, name: str, options: Mapping[str, Any]) -> None:
        check_options(f"{self.group}={name}: ", self.get(name), options)


@functools.cache
def options_of(component: Callable[..., Any]) -> dict[str, tuple[inspect.Parameter, Any]]:
    """Name -> parameter and annotation of each option of the component, its own first."""
    options: dict[str, tuple[inspect.Parameter, Any]] = {}
    for function in _signatures(component):
        hints = get_type_hints(function, include_extras=True)
        for parameter in inspect.signature(function).parameters.values():
            if parameter.kind is inspect.Parameter.KEYWORD_ONLY:
                options.setdefault(parameter.name, (parameter, hints.get(parameter.name, Any)))
    return options


def _signatures(component: Callable[..., Any]) -> Iterator[Callable[..., Any]]:
    """The function, or the class's `__init__` and those that receive its `**options`."""
    if not inspect.isclass(component):
        yield component
        return
    for ancestor in component.__mro__:
        function = vars(ancestor).get("__init__")
        if inspect.isfunction(function):
            yield function
            parameters = inspect.signature(function).parameters.values()
            if not any(parameter.kind is inspect.Parameter.VAR_KEYWORD for parameter in parameters):
                return


def check_options(where: str, component: Callable[..., Any], options: Mapping[str, Any]) -> None:
    """ValueError unless every option is a keyword-only parameter of `component` and its value fits the annotation.

    where: what comes before an option's name in messages, such as "train." or "encoder=hash: ".
    """
    known = options_of(component)
    for key, value in options.items():
        if key not in known:
            label = where.rstrip(".: ") or "config"
            raise ValueError(f"{label}: unknown option {key}={value!r}; known: {', '.join(known) or 'none'}")
        bounds.check(f"{where}{key}", value, known[key][1])
