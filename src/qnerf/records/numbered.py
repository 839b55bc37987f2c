"""Files with a number in their name, such as `owner/000012.json` and `metrics/part-00003.parquet`."""

from dataclasses import dataclass
from pathlib import Path

from qnerf.records.files import entries_in

LIMIT = 10**9
"""Larger numbers are not ours."""


@dataclass(frozen=True)
class NumberedFiles:
    """Names of the form prefix, number with at least so many digits, suffix.

    A number has one name only. `part-00000 (1).parquet`, the copy of a sync program, and `000000012.json` are not names
    of this form, nor are names with other digits than 0 to 9.

    >>> parts = NumberedFiles("part-", 5, ".parquet")
    >>> parts.name(3), parts.number("part-00003.parquet"), parts.number("part-3.parquet")
    ('part-00003.parquet', 3, None)
    """

    prefix: str
    digits: int
    suffix: str

    def name(self, number: int) -> str:
        return f"{self.prefix}{number:0{self.digits}d}{self.suffix}"

    def number(self, name: str) -> int | None:
        """The number in a name; None if the name is not of this form."""
        text = name.removeprefix(self.prefix).removesuffix(self.suffix)
        if not (text.isascii() and text.isdigit() and len(text) <= len(str(LIMIT))):
            return None
        number = int(text)
        return number if number < LIMIT and self.name(number) == name else None

    def in_folder(self, folder: Path) -> dict[int, Path]:
        """Number -> path, in ascending order, for what has such a name; it may be a link or a folder."""
        numbers = {self.number(name): folder / name for name in entries_in(folder)}
        return {number: numbers[number] for number in sorted(number for number in numbers if number is not None)}


PARTS = NumberedFiles("part-", 5, ".parquet")
"""The files of metrics/."""

OWNERS = NumberedFiles("", 6, ".json")
"""The files of owner/."""
