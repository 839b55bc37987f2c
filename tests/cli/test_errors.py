from qnerf.cli.errors import one_line


def test_an_error_is_one_line_and_escaped():
    assert one_line(ValueError("a\n  b \x1b[31m\ud800")) == "a b \\x1b[31m\\ud800"
