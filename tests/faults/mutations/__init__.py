"""What somebody's store can hold: seeded changes of a store on disk, for `tests.faults.fuzz_stores`.

A mutation is a function of a `Store` and a random generator. It changes the store and says what it did. It never writes
to `Store.outside`, the folder that the commands must not touch, except for further names of the files in it.
"""

from tests.faults.mutations import binaries, contents, files, tables
from tests.faults.mutations.store import MARK, MUTATIONS, Skipped, Store

__all__ = ["MARK", "MUTATIONS", "Skipped", "Store", "binaries", "contents", "files", "tables"]
