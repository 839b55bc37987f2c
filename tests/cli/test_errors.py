import pytest

from qnerf.cli.errors import is_shortage, one_line


def test_an_error_is_one_line_and_escaped():
    assert one_line(ValueError("a\n  b \x1b[31m\ud800")) == "a b \\x1b[31m\\ud800"


@pytest.mark.parametrize(
    ("error", "expected"),
    [
        (MemoryError(), True),
        (OSError(24, "Too many open files"), True),
        (RuntimeError("DefaultCPUAllocator: can't allocate memory: you tried to allocate 9 bytes"), True),
        (RuntimeError("can't start new thread"), True),
        (RuntimeError("shapes differ"), False),
    ],
)
def test_a_limit_of_the_system_is_told_from_a_bug(error: Exception, expected: bool) -> None:
    assert is_shortage(error) == expected
    later = ValueError("later")
    later.__cause__ = error
    assert is_shortage(later) == expected
    assert one_line(error).startswith("a limit of this system is reached") == expected
