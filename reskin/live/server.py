"""The page: http and a websocket around each board at work. In: boards. Out: what `page/` draws; nothing else.

Bound to this machine unless asked, and then behind a token. A request names a board by its index, and a button, and no
more: no path, no name and no number of a client's reaches a file. Refuses to know how anything is estimated.
"""

import asyncio
import hmac
import json
import re
import secrets
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path

from aiohttp import WSMsgType, web
from aiohttp.typedefs import Handler

from reskin.errors import ParamsError
from reskin.live.session import Live

PAGE = Path(__file__).parent / "page"
FILES = {"/": "index.html", "/live.js": "live.js", "/trace.js": "trace.js", "/live.css": "live.css"}
LOCAL = ("127.0.0.1", "localhost", "::1")
OWN_HOST = re.compile(r"(localhost|127\.0\.0\.1|\[::1\])(:[0-9]{1,5})?", re.IGNORECASE)
COOKIE = "reskin-token"
FRAME_S, STATE_S, HEARTBEAT_S = 1 / 30, 0.2, 10.0
PAGES_MAX_N, REQUEST_BYTES_MAX_N = 8, 1024
HEADERS = {
    "Content-Security-Policy": "default-src 'self'; img-src data:; frame-ancestors 'none'",
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cache-Control": "no-store",
}


class Server:
    """Answers the requests of pages; with an empty token, those that name this machine."""

    def __init__(self, boards: Sequence[Live], token: str) -> None:
        self._boards, self._token = boards, token
        self._clients: list[set[web.WebSocketResponse]] = [set() for _ in boards]  # by board: a page has one of each

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
        index = request.query.get("board", "0")
        if index not in map(str, range(len(self._boards))):
            raise web.HTTPNotFound(text="there is no such board\n")
        board, clients = self._boards[int(index)], self._clients[int(index)]
        if len(clients) >= PAGES_MAX_N:
            raise web.HTTPServiceUnavailable(text=f"{PAGES_MAX_N} pages are open; close one\n")
        page = web.WebSocketResponse(max_msg_size=REQUEST_BYTES_MAX_N, heartbeat=HEARTBEAT_S, compress=False)
        clients.add(page)
        try:
            await page.prepare(request)
            async with asyncio.TaskGroup() as group:  # which ends if either does by a fault
                sending = group.create_task(self._send(board, page))
                async for said in page:
                    if said.type == WSMsgType.TEXT:
                        await asyncio.to_thread(self._listen, board, said.data)  # a button may write files
                sending.cancel()
        finally:
            clients.discard(page)
        return page

    def _listen(self, board: Live, text: str) -> None:
        """Do what a page asks for, if it is one of the few things that it may."""
        with suppress(ValueError, RecursionError):
            said = json.loads(text)
            if isinstance(said, dict):
                board.press(said.get("press"))
                board.seen(said.get("seen"))

    async def _send(self, board: Live, page: web.WebSocketResponse) -> None:
        """Send what is new, as often as a screen shows it; a page that is slow gets less, and nothing is queued."""
        after_bin, told, next_state_s, clock = 0, "", 0.0, asyncio.get_running_loop().time
        with suppress(ConnectionError):
            while not page.closed:
                begun_s = clock()
                if begun_s >= next_state_s:
                    next_state_s = begun_s + STATE_S
                    state = json.dumps({"boards_n": len(self._boards), **board.state()})
                    if state != told:
                        await page.send_str(state)
                        told = state
                data, after_bin = board.message(after_bin)
                if data:
                    await page.send_bytes(data)
                await asyncio.sleep(max(FRAME_S - (clock() - begun_s), 0.001))

    async def _close(self, _: web.Application) -> None:
        for page in [page for clients in self._clients for page in clients]:
            await page.close()


def serve(boards: Sequence[Live], *, host: str, http_port: int, say: Callable[[str], None]) -> None:
    """Show the page of one board or more until Ctrl-C."""
    token = "" if host in LOCAL else secrets.token_urlsafe(16)
    for board in boards:
        board.start()
    try:
        address = f"http://{'localhost' if host in LOCAL else host}:{http_port}/{f'?token={token}' if token else ''}"
        say(f"{', '.join(str(board) for board in boards)}: open {address}; Ctrl-C ends it")
        web.run_app(Server(boards, token).application(), host=host, port=http_port, print=None, handle_signals=True)
    except OSError as error:
        raise ParamsError("--http-port", "the port of the page", "free", error.strerror, "Choose another.") from None
    finally:
        for board in boards:
            board.stop()
