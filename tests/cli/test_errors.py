import pytest

from qnerf.cli.errors import check_process, is_shortage, one_line


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


@pytest.mark.parametrize("threads", ["abc", "0", "-1", "1.5"])
def test_numbas_threads_are_a_number(monkeypatch: pytest.MonkeyPatch, threads: str) -> None:
    check_process()
    monkeypatch.setenv("NUMBA_NUM_THREADS", threads)
    with pytest.raises(ValueError, match=f"NUMBA_NUM_THREADS must be a whole number from 1, got '{threads}'"):
        check_process()
