"""The server of the live page."""

import socket
import threading

import uvicorn

from .answers import Answers


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
            for thread in set(threading.enumerate()) - before:
                thread.join(10)


def _name(answers: Answers, ended: threading.Event) -> None:
    while not ended.wait(1):
        if answers.store.name_configurations():
            answers.table()
