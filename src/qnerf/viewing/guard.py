"""Who may use the page of the viewer, or of `qnerf serve`: who knows its token, on a page of its own.

A browser lets any page open a WebSocket to this machine, and another user of the machine can reach its ports. So every
request must bring the token that was printed, once in the address and then as a cookie; a page of another site is
refused by its Origin; and a server for this machine alone wants to be called by a name of this machine (a foreign name
that points here is DNS rebinding).
"""

import contextlib
import hmac
import secrets
import socket
from collections.abc import Callable, Iterator
from http.cookies import CookieError, SimpleCookie
from typing import Any
from urllib.parse import parse_qs, urlsplit

COOKIE = "qnerf_view_token"
LOCAL = ("localhost", "127.0.0.1", "::1")


class Guard:
    """Refuses requests to a server that listens on `host`."""

    def __init__(self, host: str) -> None:
        self.host, self.local = host, host in LOCAL
        self.token = secrets.token_urlsafe(24)

    def address(self, port: int) -> str:
        """What to open in a browser, with the token."""
        every = self.host in ("0.0.0.0", "::")  # all networks
        name = "localhost" if self.local else socket.gethostname() if every else self.host
        return f"http://{f'[{name}]' if ':' in name else name}:{port}/?token={self.token}"

    def refusal(self, path: str, headers: Any) -> str | None:
        """Why a request is refused; None if it may pass.

        Args:
            path: with the query.
            headers: a mapping that ignores the case of names.
        """
        try:
            host, origin = headers.get("Host", ""), headers.get("Origin")
            name, site = urlsplit(f"//{host}").hostname, None if origin is None else urlsplit(origin).netloc
        except (ValueError, LookupError):  # no address; twice
            return "expected one Host and at most one Origin"
        if site not in (None, host):
            return "a page of another site asked"
        if self.local and name not in LOCAL:
            return f"expected one of {', '.join(LOCAL)} as host"
        with contextlib.suppress(CookieError):
            given = parse_qs(urlsplit(path).query).get("token", [])
            given += [morsel.value for morsel in SimpleCookie(headers.get("Cookie", "")).values()]
            if any(hmac.compare_digest(one.encode(), self.token.encode()) for one in given):
                return None
        return "expected the token: open the address that was printed"

    @contextlib.contextmanager
    def installed(self) -> Iterator[None]:
        """A viser server that is started inside answers only requests that pass. viser has no option for it."""
        from websockets.asyncio import server

        serve = server.serve

        def guarded(*arguments: Any, process_request: Callable[..., Any], **options: Any) -> Any:
            def process(connection: Any, request: Any) -> Any:
                if refusal := self.refusal(request.path, request.headers):
                    return connection.respond(403, refusal + "\n")
                response = process_request(connection, request)
                if response is not None:
                    name = f"{COOKIE}_{connection.local_address[1]}"  # a browser keeps those of all ports together
                    response.headers["Set-Cookie"] = f"{name}={self.token}; HttpOnly; SameSite=Strict; Path=/"
                return response

            return serve(*arguments, process_request=process, **options)

        server.serve = guarded  # type: ignore[misc, assignment]
        try:
            yield
        finally:
            server.serve = serve  # type: ignore[misc]
