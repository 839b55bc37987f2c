"""The server of the live page."""

import asyncio
import socket
import threading

import uvicorn
from uvicorn.protocols.http.h11_impl import H11Protocol

from .answers import Answers

REQUEST_WITHIN = 10.0  # seconds until a connection has to have sent a whole request
MOST_CONNECTIONS = 200


class Prompt(H11Protocol):
    """A connection that is closed if it begins a request and does not end it."""

    _watch: asyncio.TimerHandle | None = None

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        super().connection_made(transport)
        self._watch = self.loop.call_later(REQUEST_WITHIN, self._close_if_waiting)

    def data_received(self, data: bytes) -> None:
        super().data_received(data)
        if not self._waits() and self._watch is not None:
            self._watch.cancel()
            self._watch = None
        elif self._waits() and self._watch is None:  # the first bytes of a further request; more do not renew it
            self._watch = self.loop.call_later(REQUEST_WITHIN, self._close_if_waiting)

    def _waits(self) -> bool:
        return self.cycle is None or self.cycle.response_complete

    def _close_if_waiting(self) -> None:
        if self._waits():
            self.transport.close()


class Server(uvicorn.Server):
    """Serves the page; meanwhile it names the configurations of new runs and packs a table that has changed much.

    When `run` returns, its threads have ended. Python would end a thread that still reads parquet by unwinding Arrow's
    C++, which aborts the process.
    """

    def __init__(self, config: uvicorn.Config, answers: Answers) -> None:
        super().__init__(config)
        self.answers = answers

    def run(self, sockets: list[socket.socket] | None = None) -> None:
        before = set(threading.enumerate())
        ended = threading.Event()
        threading.Thread(target=_name, args=(self.answers, ended), name="qnerf-serve-names", daemon=True).start()
        try:
            super().run(sockets)
        finally:
            ended.set()
            self.answers.close()
            for thread in set(threading.enumerate()) - before:
                thread.join(10)


def _name(answers: Answers, ended: threading.Event) -> None:
    while not ended.wait(1):
        if answers.store.name_configurations():
            answers.table()
