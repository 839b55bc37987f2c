"""Standard output and standard error, which must not fail for a character that their encoding lacks."""

import sys


def escape_unencodable() -> None:
    """Characters that the encoding lacks, such as an umlaut in ASCII, are printed as escapes from now on."""
    for stream in (sys.stdout, sys.stderr):
        if hasattr(stream, "reconfigure"):
            stream.reconfigure(errors="backslashreplace")
