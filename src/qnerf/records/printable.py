"""Text of files and users, made safe to show in a terminal."""

ELLIPSIS = "…"


def printable(value: object, limit: int | None = None, *, lines: bool = False) -> str:
    r"""`value` as text for a terminal, on one line.

    Control characters (escape sequences, newlines), invisible characters and those that change the direction of writing
    become escapes such as `\x1b` and `\u202e`. limit: longer text is cut and ends with an ellipsis. lines: newlines
    stay. Rich must not read the result as markup: pass it to `rich.text.Text` or to `cli.text.console()`.

    >>> print(printable("red \x1b[31m\nnext line"))
    red \x1b[31m\nnext line
    >>> print(printable("a long name", 7))
    a long…
    """
    text = str(value)
    if limit is not None and len(text) > limit:
        text = text[: limit - 1] + ELLIPSIS
    return "".join(c if c.isprintable() or (lines and c == "\n") else _escape(c) for c in text)


def _escape(character: str) -> str:
    return character.encode("unicode_escape").decode("ascii")
