"""Text that somebody else wrote, made safe to show."""

ELLIPSIS = "…"


def printable(value: object, limit: int | None = None, *, lines: bool = False) -> str:
    r"""`value` as text for a terminal, on one line.

    Control characters (escape sequences, newlines), invisible ones and those that turn the direction of writing become
    escapes such as `\x1b` and `\u202e`. limit: most characters; the rest is cut with an ellipsis. lines: newlines stay.
    Rich must not read the result as markup: give it to `rich.text.Text`, or print it with `console_text.console()`.
    """
    text = str(value)
    if limit is not None and len(text) > limit:
        text = text[: limit - 1] + ELLIPSIS
    return "".join(c if c.isprintable() or (lines and c == "\n") else _escape(c) for c in text)


def _escape(character: str) -> str:
    return character.encode("unicode_escape").decode("ascii")
