"""The server of the live page."""

import socket
import threading

import uvicorn

from .store import WatchedStore


class Server(uvicorn.Server):
    """Serves the page, and names the configurations of new runs meanwhile.

    When `run` returns, its threads have ended. Python would end a thread that still reads parquet by unwinding Arrow's
    C++, which aborts the process.
    """

    def __init__(self, config: uvicorn.Config, store: WatchedStore) -> None:
        super().__init__(config)
        self.store = store

    def run(self, sockets: list[socket.socket] | None = None) -> None:
        before = set(threading.enumerate())
        ended = threading.Event()
        threading.Thread(target=_name, args=(self.store, ended), name="qnerf-serve-names", daemon=True).start()
        try:
            super().run(sockets)
        finally:
            ended.set()
            for thread in set(threading.enumerate()) - before:
                thread.join(10)


def _name(store: WatchedStore, ended: threading.Event) -> None:
    while not ended.wait(1):
        store.name_configurations()
