"""Stores behind a URL that fsspec reads, such as s3://bucket/runs: what is asked for is copied into a folder here.

A run of another machine counts as running while its last heartbeat is recent.
"""

import contextlib
import os
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path, PurePosixPath

from qnerf.records.files import StoreError, one_line
from qnerf.records.location import url_protocol


@contextlib.contextmanager
def local_copy(url: str, wanted: Callable[[PurePosixPath], bool]) -> Iterator[Path]:
    """A temporary folder with the wanted files, by their paths below the URL; StoreError if they cannot be read."""
    import fsspec

    with tempfile.TemporaryDirectory() as folder:
        try:
            storage, root = fsspec.url_to_fs(url.rstrip("/"))
            below = {path: PurePosixPath(os.path.relpath(path, root)) for path in storage.find(root)}
            chosen = {path: name for path, name in below.items() if ".." not in name.parts and wanted(name)}
            if not below:  # find() takes a server that does not answer for an empty folder
                with contextlib.suppress(FileNotFoundError):
                    storage.ls(root)
            storage.get(list(chosen), [str(Path(folder, name)) for name in chosen.values()])
        except ImportError as error:
            extra = "pip install 'qnerf[s3]'" if url_protocol(url) == "s3" else one_line(error)
            raise StoreError(f"{url}: reading {url_protocol(url)}:// needs another package: {extra}") from error
        except Exception as error:  # every storage has its own errors
            raise StoreError(f"{url}: cannot read: {one_line(error)}") from error
        yield Path(folder)
