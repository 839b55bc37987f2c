"""`qnerf serve` in a thread."""

import contextlib
import socket
import threading
import urllib.parse

from qnerf.analysis.serve.__main__ import make, parser

EVIL = "<img src=x onerror=alert(1)></script><script>alert(2)</script>"


TOKENS = {}  # port -> token


def cookie(address):
    """The header with which a browser that has opened the printed address asks."""
    port = urllib.parse.urlsplit(address).port
    return {"Cookie": f"qnerf_token_{port}={TOKENS[port]}"}


@contextlib.contextmanager
def served(*arguments):
    """A running server: its address and the token of visitors, which `cookie` brings."""
    options = parser().parse_args([*map(str, arguments)])
    server, guard = make(options)
    with socket.create_server(("127.0.0.1", 0)) as listening:
        thread = threading.Thread(target=server.run, args=([listening],), daemon=True)
        thread.start()
        port = listening.getsockname()[1]
        TOKENS[port] = guard.token
        yield f"http://127.0.0.1:{port}", guard.token
        server.should_exit = True
        thread.join(10)
