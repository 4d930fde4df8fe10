"""The page: http and a websocket around a skin at work. In: a port, models. Out: what `page/` draws; nothing else.

Bound to this machine unless asked, and then behind a token. A request names a button and no more: no path, no name and
no number of a client's reaches a file. Refuses to know how anything is estimated.
"""

import asyncio
import hmac
import json
import re
import secrets
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

from aiohttp import WSMsgType, web
from aiohttp.typedefs import Handler

from pipeline.core.errors import ParamsError
from pipeline.live.session import Live

PAGE = Path(__file__).parent / "page"
FILES = {"/": "index.html", "/live.js": "live.js", "/live.css": "live.css"}
LOCAL = ("127.0.0.1", "localhost", "::1")
OWN_HOST = re.compile(r"(localhost|127\.0\.0\.1|\[::1\])(:[0-9]{1,5})?", re.IGNORECASE)
COOKIE = "reskin-token"
FRAME_S, STATE_S, HEARTBEAT_S = 1 / 30, 0.2, 10.0
CLIENTS_MAX_N, REQUEST_BYTES_MAX_N = 8, 1024
HEADERS = {
    "Content-Security-Policy": "default-src 'self'; img-src data:; frame-ancestors 'none'",
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cache-Control": "no-store",
}


class Server:
    """Answers the requests of pages; with an empty token, those that name this machine."""

    def __init__(self, live: Live, token: str) -> None:
        self._live, self._token = live, token
        self._clients: set[web.WebSocketResponse] = set()

    def application(self) -> web.Application:
        @web.middleware
        async def check(request: web.Request, handler: Handler) -> web.StreamResponse:
            return await self._check(request, handler)

        app = web.Application(middlewares=[check], client_max_size=REQUEST_BYTES_MAX_N)
        app.router.add_get("/live", self._talk)
        for path in FILES:
            app.router.add_get(path, self._file)
        app.on_shutdown.append(self._close)
        return app

    async def _check(self, request: web.Request, handler: Handler) -> web.StreamResponse:
        given = request.query.get("token") or request.cookies.get(COOKIE, "")
        origin = request.headers.get("Origin")
        if self._token and not hmac.compare_digest(given.encode(errors="replace"), self._token.encode()):
            raise web.HTTPForbidden(text="this page needs its token: use the address that was printed\n")
        if not self._token and not OWN_HOST.fullmatch(request.host):  # any site's name may lead to this machine
            raise web.HTTPForbidden(text="this page answers to localhost and 127.0.0.1\n")
        if origin is not None and origin.partition("://")[2] != request.host:
            raise web.HTTPForbidden(text="this page answers to itself\n")
        return await handler(request)

    async def _file(self, request: web.Request) -> web.StreamResponse:
        response = web.FileResponse(PAGE / FILES[request.path], headers=HEADERS)
        if self._token:
            response.set_cookie(COOKIE, self._token, httponly=True, samesite="Strict")
        return response

    async def _talk(self, request: web.Request) -> web.StreamResponse:
        if len(self._clients) >= CLIENTS_MAX_N:
            raise web.HTTPServiceUnavailable(text=f"{CLIENTS_MAX_N} pages are open; close one\n")
        page = web.WebSocketResponse(max_msg_size=REQUEST_BYTES_MAX_N, heartbeat=HEARTBEAT_S, compress=False)
        self._clients.add(page)
        try:
            await page.prepare(request)
            async with asyncio.TaskGroup() as group:  # which ends if either does by a fault
                sending = group.create_task(self._send(page))
                async for said in page:
                    if said.type == WSMsgType.TEXT:
                        await asyncio.to_thread(self._listen, said.data)  # a button may write files
                sending.cancel()
        finally:
            self._clients.discard(page)
        return page

    def _listen(self, text: str) -> None:
        """Do what a page asks for, if it is one of the few things that it may."""
        with suppress(ValueError, RecursionError):
            said = json.loads(text)
            if isinstance(said, dict):
                self._live.press(said.get("press"))
                self._live.seen(said.get("seen"))

    async def _send(self, page: web.WebSocketResponse) -> None:
        """Send what is new, as often as a screen shows it; a page that is slow gets less, and nothing is queued."""
        after_bin, told, next_state_s, clock = 0, "", 0.0, asyncio.get_running_loop().time
        with suppress(ConnectionError):
            while not page.closed:
                begun_s = clock()
                if begun_s >= next_state_s:
                    next_state_s = begun_s + STATE_S
                    state = json.dumps(self._live.state())
                    if state != told:
                        await page.send_str(state)
                        told = state
                data, after_bin = self._live.message(after_bin)
                if data:
                    await page.send_bytes(data)
                await asyncio.sleep(max(FRAME_S - (clock() - begun_s), 0.001))

    async def _close(self, _: web.Application) -> None:
        for page in list(self._clients):
            await page.close()


def serve(live: Live, *, host: str, http_port: int, say: Callable[[str], None]) -> None:
    """Show a board's page until Ctrl-C."""
    token = "" if host in LOCAL else secrets.token_urlsafe(16)
    live.start()
    try:
        address = f"http://{'localhost' if host in LOCAL else host}:{http_port}/{f'?token={token}' if token else ''}"
        say(f"{live.what} on {live.skin.port}: open {address}; Ctrl-C ends it")
        web.run_app(Server(live, token).application(), host=host, port=http_port, print=None, handle_signals=True)
    except OSError as error:
        raise ParamsError("--http-port", "the port of the page", "free", error.strerror, "Choose another.") from None
    finally:
        live.stop()
