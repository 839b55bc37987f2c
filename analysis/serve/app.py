"""What the live page asks for: the page, what changed, curves, pictures, tables of differences; and who may ask.

Everything is only read. Who may ask is as for the viewer (`qnerf.viewing.guard`).
"""

import asyncio
from pathlib import Path
from typing import Any

import plotly.offline
from starlette.applications import Starlette
from starlette.concurrency import run_in_threadpool
from starlette.middleware import Middleware
from starlette.middleware.base import BaseHTTPMiddleware, RequestResponseEndpoint
from starlette.middleware.gzip import GZipMiddleware
from starlette.requests import Request
from starlette.responses import HTMLResponse, JSONResponse, PlainTextResponse, RedirectResponse, Response
from starlette.routing import Route

from qnerf.records.files import one_line
from qnerf.viewing.guard import Guard

from ..report import page
from .answers import Answers

HERE = Path(__file__).parent
COOKIE = "qnerf_token"
OWN = ("live", "differences")
SCRIPTS = ("data", "live", *page.SHARED, "differences", "start")
HEADERS = {
    "Content-Security-Policy": (
        "default-src 'none'; script-src 'self'; style-src 'self' 'unsafe-inline'; img-src 'self' data: blob:; "
        "connect-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
    ),
    "Cross-Origin-Resource-Policy": "same-origin",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Referrer-Policy": "no-referrer",
    "X-Content-Type-Options": "nosniff",
    "Cache-Control": "no-store",
}


def application(answers: Answers, guard: Guard) -> Starlette:
    """The server's application, for visitors whom the guard lets in."""
    files = {
        "page.js": (
            "text/javascript",
            "\n".join(page.file(f"{name}.js", HERE if name in OWN else page.HERE) for name in SCRIPTS),
        ),
        "plotly.js": ("text/javascript", plotly.offline.get_plotlyjs()),
        "style.css": ("text/css", page.file("style.css")),
    }

    turn = asyncio.Lock()  # what takes long is made one at a time, so that threads are left for the rest

    async def home(request: Request) -> Response:
        if "token" in request.query_params:
            return _with_cookie(request, guard.token)
        async with turn:
            return HTMLResponse(await run_in_threadpool(lambda: page.render(answers.page())))

    def file(request: Request) -> Response:
        kind, text = files[request.url.path[1:]]
        return Response(text, media_type=kind, headers={"Cache-Control": "no-cache"})

    def changes(request: Request) -> Response:
        return JSONResponse(answers.changes(request.query_params.get("since", "")))

    def curves(request: Request) -> Response:
        return JSONResponse(answers.curves(request.query_params.getlist("run"), request.query_params["key"]))

    def keys(request: Request) -> Response:
        return JSONResponse(answers.keys(request.query_params.getlist("run")))

    def views(request: Request) -> Response:
        return JSONResponse(answers.views(request.query_params["run"]))

    def picture(request: Request) -> Response:
        query = request.query_params
        data, kind = answers.picture(query["run"], query["view"], query["panel"])
        seconds = 3600 if query["panel"] == "preview" else 10  # the address of a preview tells its version
        return Response(data, media_type=kind, headers={"Cache-Control": f"private, max-age={seconds}"})

    async def differences(request: Request) -> Response:
        asked = (request.query_params.get(name, "") for name in ("filter", "rows", "baseline", "metric", "within"))
        async with turn:
            return HTMLResponse(await run_in_threadpool(lambda: page.table(answers.differences(*asked))))

    routes = [
        Route("/", home),
        *(Route(f"/{name}", file) for name in files),
        *(Route(f"/{make.__name__}", make) for make in (changes, curves, keys, views, picture, differences)),
    ]

    async def guarded(request: Request, answer: RequestResponseEndpoint) -> Response:
        refusal = guard.refusal(f"{request.url.path}?{request.url.query}", request.headers)
        response = await answer(request) if refusal is None else PlainTextResponse(refusal, 403)
        for name, value in HEADERS.items():
            response.headers.setdefault(name, value)
        return response

    middleware = [
        Middleware(BaseHTTPMiddleware, dispatch=guarded),
        Middleware(GZipMiddleware, minimum_size=2000, compresslevel=1),
    ]
    refusals: dict[Any, Any] = dict.fromkeys((KeyError, ValueError, OSError), _refusal)
    return Starlette(routes=routes, middleware=middleware, exception_handlers=refusals)


def _refusal(_: Request, error: Exception) -> Response:
    """One line for what was asked wrongly, or what a run lacks."""
    return PlainTextResponse(f"expected {error}" if isinstance(error, KeyError) else one_line(error), 400)


def _with_cookie(request: Request, token: str) -> Response:
    """Keeps the token out of the address bar. The cookie's name tells servers on other ports of this machine apart."""
    response = RedirectResponse("/", 303)
    response.set_cookie(f"{COOKIE}_{request.url.port or 80}", token, httponly=True, samesite="strict")
    return response
