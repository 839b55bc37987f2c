"""Whether every tensor of a `torch.save` archive lies within the bytes that the archive holds for it.

The archive's pickle names the length of each tensor's storage, and the storage is a file of the archive. PyTorch 2.6
trusts the name: a longer one gives a tensor that reads and writes memory beyond its end. PyTorch 2.13 compares them.
"""

import io
import math
import pickle
import zipfile
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

ELEMENT_BYTES = {
    "BoolStorage": 1, "ByteStorage": 1, "CharStorage": 1, "ShortStorage": 2, "IntStorage": 4, "LongStorage": 8,
    "HalfStorage": 2, "BFloat16Storage": 2, "FloatStorage": 4, "DoubleStorage": 8,
}  # fmt: skip
"""The kinds of tensors that a checkpoint may hold."""


def check_bounds(archive: zipfile.ZipFile) -> None:
    """Raises an error, most often UnpicklingError, unless all tensors lie within their files. Executes nothing."""
    items = archive.infolist()
    # Otherwise PyTorch's reader, which ignores case and bytes in front of an archive, could see another archive.
    if len({item.filename.lower() for item in items}) < len(items) or min(item.header_offset for item in items):
        raise zipfile.BadZipFile("expected an archive from the file's first byte on, with each name once")
    folders = {item.filename.partition("/")[0] for item in items}
    if len(folders) != 1:
        raise zipfile.BadZipFile("expected one folder in the archive")
    sizes = {item.filename.partition("/")[2]: item.file_size for item in items}
    try:
        _Pickle(archive.read(f"{folders.pop()}/data.pkl"), sizes).load()
    except MemoryError:
        raise pickle.UnpicklingError("names more memory than an archive of its size can hold") from None


class _Storage(NamedTuple):
    elements: int


class _Tensor:
    __slots__ = ()


class _Dict(dict[Any, Any]):
    """In place of an OrderedDict, which may have attributes, too."""


class _Pickle(pickle._Unpickler):
    """Reads the pickle with stand-ins for storages and tensors.

    It is Python's slow reader, which takes memory only for what the pickle holds.
    """

    def __init__(self, data: bytes, sizes: Mapping[str, int]) -> None:
        super().__init__(io.BytesIO(data))
        self.sizes = sizes

    def find_class(self, module: str, name: str) -> Any:
        if (module, name) == ("collections", "OrderedDict"):
            return _Dict
        if (module, name) == ("torch._utils", "_rebuild_tensor_v2"):
            return _tensor
        if module == "torch" and name in ELEMENT_BYTES:
            return name
        raise pickle.UnpicklingError(f"expected tensors and plain values only, got {module}.{name}")

    def persistent_load(self, reference: Any) -> _Storage:
        _, kind, key, _, elements = reference
        expected, size = elements * ELEMENT_BYTES[kind], self.sizes[f"data/{key}"]
        if expected != size:
            raise pickle.UnpicklingError(f"a tensor's storage should have {expected:,} bytes, it has {size:,}")
        return _Storage(elements)


def _tensor(storage: Any, offset: int, shape: Sequence[int], strides: Sequence[int], *_: Any) -> _Tensor:
    """In place of `torch._utils._rebuild_tensor_v2`, with the same arguments."""
    if type(storage) is not _Storage or min([offset, *shape, *strides]) < 0:
        raise pickle.UnpicklingError("expected a tensor of a storage")
    last = offset + sum((length - 1) * stride for length, stride in zip(shape, strides, strict=True))
    if math.prod(shape) and last >= storage.elements:
        raise pickle.UnpicklingError(f"a tensor ends at element {last} of a storage of {storage.elements}")
    return _Tensor()
