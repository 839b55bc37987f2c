import pytest

from qnerf.config.registry import Registry
from qnerf.heads import HEADS


@pytest.fixture
def registry():
    shapes = Registry("shape")

    @shapes.register("circle")
    class Circle:
        def __init__(
            self, in_dim: int, *, radius: float = 1.0, corners: int = 0, tags: list[int] | None = None
        ) -> None:
            self.given = (in_dim, radius, corners, tags)

    return shapes


def test_registry_builds_with_wiring_and_options(registry):
    assert registry.build("circle", 3, radius=2, tags=[1]).given == (3, 2, 0, [1])


def test_registry_names_what_does_not_fit_and_the_known(registry):
    for name, options, message in (
        ("square", {}, "^shape: unknown name 'square'; known: circle$"),
        ("circle", {"side": 1}, "^shape=circle: unknown option side=1; known: radius, corners, tags$"),
        ("circle", {"radius": "x"}, "shape=circle: radius expects .* got 'x'"),
        ("circle", {"radius": True}, "shape=circle: radius expects .* got True"),
        ("circle", {"corners": 1.5}, "shape=circle: corners expects .* got 1.5"),
        ("circle", {"corners": None}, "shape=circle: corners expects .* got None"),
        ("circle", {"tags": 3}, "shape=circle: tags expects .* got 3"),
    ):
        with pytest.raises(ValueError, match=message):
            registry.build(name, 3, **options)
    with pytest.raises(ValueError, match="unknown option in_dim"):  # which the code gives, and no user
        registry.check("circle", {"in_dim": 3})


def test_a_class_that_hands_its_options_on_has_those_of_its_parent(registry):
    circle = registry.get("circle")

    @registry.register("ring")
    class Ring(circle):
        def __init__(self, in_dim: int, *, hole: float = 0.5, **options) -> None:
            super().__init__(in_dim, **options)

    @registry.register("disc")
    class Disc(circle):
        def __init__(self, in_dim: int, *, thickness: float = 0.5) -> None:
            super().__init__(in_dim)

    assert list(registry.options("ring")) == ["hole", "radius", "corners", "tags"]
    assert list(registry.options("disc")) == ["thickness"]
    assert registry.build("ring", 3, radius=2.0, hole=1).given == (3, 2.0, 0, None)
    with pytest.raises(ValueError, match="shape=ring: radius expects float, got 'x'"):
        registry.build("ring", 3, radius="x")
    assert registry.name_of(Ring) == "ring"
    assert registry.name_of(int) is None


@pytest.mark.parametrize("option", ["name", "self"])
def test_an_option_may_not_hide_an_argument(option):
    with pytest.raises(ValueError, match=f"head=mlp: unknown option {option}=3; known: layers"):
        HEADS.build("mlp", 3, 2, **{option: 3})
