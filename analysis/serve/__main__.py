"""`qnerf serve STORE`: see `--help`."""

import argparse
import contextlib
import socket
import threading
from collections.abc import Sequence
from typing import TYPE_CHECKING

from qnerf.cli.numbers import whole
from qnerf.records.location import DEFAULT
from qnerf.viewing.guard import Guard

from .. import command
from .answers import Answers
from .store import WatchedStore

if TYPE_CHECKING:
    import uvicorn

DESCRIPTION = """\
Shows a store of runs on a page that follows it: runs appear and curves grow while they train. The page is the report
with more in it: any metric with mean and band over seeds, differences from a baseline of your choice. Only
who has the printed address can open it. Needs the extra serve.
"""
EXAMPLES = """\
  {}
  {} runs --port 9000
  ssh -L 8090:localhost:8090 MACHINE      # then open the printed address here
"""
PORT = 8090


def parser() -> argparse.ArgumentParser:
    made = command.parser("serve", DESCRIPTION, EXAMPLES)
    made.add_argument("store", nargs="?", default=DEFAULT, metavar="STORE", help="folder of runs (default: runs)")
    command.add_columns(made)
    made.add_argument(
        "--port", type=whole(0, 65_535), default=PORT, metavar="N", help=f"default: {PORT}; 0: any free one"
    )
    made.add_argument(
        "--host",
        default="127.0.0.1",
        help="address to listen on (default: this machine alone)",
    )
    made.add_argument("--title", default="Runs", help="the page's heading (default: Runs)")
    return made


def main(arguments: Sequence[str] | None = None) -> None:
    options = parser().parse_args(arguments)
    server, guard = make(options)
    family = socket.AF_INET6 if ":" in options.host else socket.AF_INET
    with socket.create_server((options.host, options.port), family=family) as listening:
        print(f"{options.store}: {guard.address(listening.getsockname()[1])}  (Ctrl-C ends)", flush=True)
        before = set(threading.enumerate())
        with contextlib.suppress(KeyboardInterrupt):
            server.run(sockets=[listening])
        # Python would end a thread that still reads parquet by unwinding Arrow's C++, which aborts the process.
        for thread in set(threading.enumerate()) - before:
            thread.join(10)


def make(options: argparse.Namespace) -> tuple["uvicorn.Server", Guard]:
    """The server, which does not listen yet, and the guard that visitors need to pass."""
    import uvicorn

    from .app import application

    columns = {name: getattr(options, name) for name in command.COLUMNS}
    answers = Answers(WatchedStore(options.store, **columns), options.title)
    guard = Guard(options.host)
    config = uvicorn.Config(
        application(answers, guard), log_level="error", access_log=False, ws="none",
        timeout_graceful_shutdown=1, lifespan="off", server_header=False,
    )  # fmt: skip
    return uvicorn.Server(config), guard


if __name__ == "__main__":
    command.run(main)
