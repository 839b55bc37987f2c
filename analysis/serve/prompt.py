"""Connections of the live page's server."""

import asyncio

import h11
from uvicorn.protocols.http.h11_impl import H11Protocol, RequestResponseCycle

WITHIN = 10.0  # seconds for which a connection may have sent no whole request


class Prompt(H11Protocol):
    """A connection that is closed unless it sends whole requests in time."""

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        super().connection_made(transport)
        self.loop.call_later(WITHIN, self._check, None)

    def _check(self, before: RequestResponseCycle | None) -> None:
        """before: the request that was there at the last check; the same one now, and not whole, is too slow."""
        if self.cycle is before and self.conn.their_state in (h11.IDLE, h11.SEND_BODY):
            self.transport.close()
        if not self.transport.is_closing():
            self.loop.call_later(WITHIN, self._check, self.cycle)
