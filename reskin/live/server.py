"""The web server of `reskin live`.

The server sends an HTML page, and opens one websocket for each board on each open page.

By default, only programs on the same machine can connect to the server. If the server listens on an address that other
machines can reach, every request needs a token. A client can request only the files of the page, the boards, and the
actions of the page's buttons. The only file names that a client can choose are those of saved skins, and all of these
files are in one folder.
"""

import asyncio
import errno
import hmac
import json
import logging
import re
import secrets
from collections.abc import Callable, Sequence
from contextlib import suppress
from functools import cache
from pathlib import Path
from socket import AF_INET, SOCK_DGRAM, gaierror, gethostname
from socket import socket as Socket
from typing import Any

from aiohttp import WSMsgType, web
from aiohttp.typedefs import Handler

from reskin.errors import ParamsError
from reskin.live.session import Session

PAGE = Path(__file__).parent / "page"
FILES = {"/": "index.html"} | {f"/{name}": name for name in ("live.js", "skin.js", "trace.js", "live.css")}
LOCAL, ANY = ("127.0.0.1", "localhost", "::1"), ("0.0.0.0", "::")
LOCAL_HOST = re.compile(r"(localhost|127\.0\.0\.1|\[::1\])(:[0-9]{1,5})?", re.IGNORECASE)
COOKIE = "reskin-token"
FRAME_S, STATE_S, HEARTBEAT_S = 1 / 30, 0.2, 10.0
# A connection is closed if its first request is not complete after `REQUEST_S`, or at once if there are too many
# connections. Connections are checked once per `CHECK_S`.
REQUEST_S, CHECK_S, CONNECTIONS_MAX_N, BACKLOG_N = 5.0, 0.5, 256, 16
KEPT_ALIVE_S = 10.0  # an idle connection is closed after this time since its last request
PAGES_MAX_N, REQUEST_BYTES_MAX_N = 8, 1024
HEADERS = {
    "Content-Security-Policy": "default-src 'self'; img-src data:; frame-ancestors 'none'",
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cache-Control": "no-store",
}


class Server:
    """The server of the page for one or more boards.

    If the token is empty, the server allows only requests that are addressed to a local host name.
    """

    def __init__(self, sessions: Sequence[Session], token: str) -> None:
        self._sessions, self._token = sessions, token
        self._sockets: list[set[web.WebSocketResponse]] = [set() for _ in sessions]  # open sockets of each board
        self._asked: set[web.RequestHandler] = set()  # open connections that have sent a request
        # time for which each of the other connections has been open
        self._silent_s: dict[web.RequestHandler, float] = {}

    def application(self) -> web.Application:
        @web.middleware
        async def check(request: web.Request, handler: Handler) -> web.StreamResponse:
            self._asked.add(request.protocol)
            self.check(request)
            return await handler(request)

        app = web.Application(middlewares=[check], client_max_size=REQUEST_BYTES_MAX_N)
        app.router.add_get("/live", self._connect)
        for path in FILES:
            app.router.add_get(path, self._file)
        app.on_shutdown.append(self._close)
        return app

    async def run(self, host: str, http_port: int, say: Callable[[], None]) -> None:
        """Serve the page until the process is interrupted. Call `say` as soon as the server listens."""
        asyncio.get_running_loop().set_exception_handler(_log_unless_table_is_full)
        runner = web.AppRunner(self.application(), handle_signals=True, keepalive_timeout=KEPT_ALIVE_S)
        await runner.setup()
        try:
            await web.TCPSite(runner, host, http_port, backlog=BACKLOG_N).start()
            say()
            while runner.server is not None:
                self._close_idle(runner.server.connections)
                await asyncio.sleep(CHECK_S)
        finally:
            await runner.cleanup()

    def _close_idle(self, connections: Sequence[web.RequestHandler]) -> None:
        """Close connections that have sent no complete request for too long, and the oldest ones of too many."""
        self._asked.intersection_update(connections)
        silent = [connection for connection in connections if connection not in self._asked]
        self._silent_s = {connection: self._silent_s.get(connection, 0.0) + CHECK_S for connection in silent}
        too_many_n = len(connections) - CONNECTIONS_MAX_N
        for i, (connection, silent_s) in enumerate(self._silent_s.items()):
            if i < too_many_n or silent_s > REQUEST_S:
                connection.force_close()

    def check(self, request: web.Request) -> None:
        """Raise `HTTPForbidden` if the token is wrong, or if the request's host or origin is not allowed."""
        token = request.query.get("token") or request.cookies.get(COOKIE, "")
        origin = request.headers.get("Origin")
        if self._token and not hmac.compare_digest(token.encode(errors="replace"), self._token.encode()):
            raise web.HTTPForbidden(
                text="the token in the address is missing or wrong: use the address that `reskin live` has printed\n"
            )
        # Without a token, the host name is checked. This is a protection against DNS rebinding, in which another web
        # site lets its own host name point to this machine.
        if not self._token and not LOCAL_HOST.fullmatch(request.host):
            raise web.HTTPForbidden(text="this page can only be opened as localhost or 127.0.0.1\n")
        if origin is not None and origin.partition("://")[2] != request.host:
            raise web.HTTPForbidden(text="this page accepts no requests from other sites\n")

    async def _file(self, request: web.Request) -> web.StreamResponse:
        response = web.FileResponse(PAGE / FILES[request.path], headers=HEADERS)
        if self._token:
            response.set_cookie(COOKIE, self._token, httponly=True, samesite="Strict")
        return response

    async def _connect(self, request: web.Request) -> web.StreamResponse:
        """Serve one websocket until it is closed.

        The server sends new data of a board, and receives the actions of the user.
        """
        index = request.query.get("board", "0")
        if index not in map(str, range(len(self._sessions))):
            raise web.HTTPNotFound(text="there is no such board\n")
        session, sockets = self._sessions[int(index)], self._sockets[int(index)]
        if len(sockets) >= PAGES_MAX_N:
            raise web.HTTPServiceUnavailable(text=f"{PAGES_MAX_N} pages are open already; close one of them\n")
        socket = web.WebSocketResponse(max_msg_size=REQUEST_BYTES_MAX_N, heartbeat=HEARTBEAT_S, compress=False)
        sockets.add(socket)
        try:
            await socket.prepare(request)
            async with asyncio.TaskGroup() as group:  # an error in sending or receiving ends both tasks
                sending = group.create_task(self._send(session, socket))
                async for message in socket:
                    if message.type == WSMsgType.TEXT:
                        # The action is performed in another thread, because it may write files, which takes time.
                        await asyncio.to_thread(receive, session, message.data)
                sending.cancel()
        finally:
            sockets.discard(socket)
        return socket

    async def _send(self, session: Session, socket: web.WebSocketResponse) -> None:
        """Send a board's new data to a page 30 times per second, or less often if the page is slow."""
        after_bin, sent_state, next_state_s, clock = 0, "", 0.0, asyncio.get_running_loop().time
        with suppress(ConnectionError):
            while not socket.closed:
                start_s = clock()
                if start_s >= next_state_s:
                    next_state_s = start_s + STATE_S
                    state = json.dumps({"boards_n": len(self._sessions), **session.state()})
                    if state != sent_state:
                        await socket.send_str(state)
                        sent_state = state
                data, after_bin = session.message(after_bin)
                if data:
                    await socket.send_bytes(data)
                await asyncio.sleep(max(FRAME_S - (clock() - start_s), 0.001))

    async def _close(self, _: web.Application) -> None:
        for socket in [socket for sockets in self._sockets for socket in sockets]:
            await socket.close()


def receive(session: Session, text: str) -> None:
    """Handle a JSON message from a page (see `Session.request`). A text that is not such a message is ignored."""
    with suppress(ValueError, RecursionError):
        message = json.loads(text)
        if isinstance(message, dict):
            session.request(message)


def _log_unless_table_is_full(loop: asyncio.AbstractEventLoop, context: dict[str, Any]) -> None:
    """Handle an error of the event loop. An error because too many files are open is logged once, in one line."""
    error = context.get("exception")
    if not isinstance(error, OSError) or error.errno not in (errno.EMFILE, errno.ENFILE):
        loop.default_exception_handler(context)
    else:
        _log_once(f"too many open files: connections to the page must wait ({error.strerror})")


@cache
def _log_once(message: str) -> None:
    logging.getLogger(__name__).warning(message)


def address_of(host: str) -> str:
    """Return the address at which a browser can open the page; for 0.0.0.0, that of this machine in its network."""
    if host in LOCAL:
        return "localhost"
    if host not in ANY:
        return f"[{host}]" if ":" in host else host
    with Socket(AF_INET, SOCK_DGRAM) as probe:
        try:
            probe.connect(("192.0.2.1", 9))  # sends nothing, but selects the network over which others are reached
            return probe.getsockname()[0]
        except OSError:  # there is no network
            return gethostname()


def serve(
    sessions: Sequence[Session], *, host: str, http_port: int, say: Callable[[str], None], where: str = ""
) -> None:
    """Serve the page of one or more boards until Ctrl-C.

    As soon as the server listens, `say` is called with a text that contains the address of the page and ends with
    `where`, which names the folders of saved files.
    """
    token = "" if host in LOCAL else secrets.token_urlsafe(16)
    for session in sessions:
        session.start()
    try:
        address = f"http://{address_of(host)}:{http_port}/{f'?token={token}' if token else ''}"
        announcement = f"{', '.join(map(str, sessions))}: open {address}; press Ctrl-C to stop"
        announcement += f"\n{where}" if where else ""
        with suppress(KeyboardInterrupt, web.GracefulExit):
            asyncio.run(Server(sessions, token).run(host, http_port, lambda: say(announcement)))
    except OSError as error:
        if isinstance(error, gaierror) or error.errno in (None, errno.EADDRNOTAVAIL):
            remedy = "Try 127.0.0.1 (only this machine can connect) or 0.0.0.0 (other machines can connect too)."
            raise ParamsError(f"--host: {host} is not an address of this machine. {remedy}") from None
        reason = "another program uses it" if error.errno == errno.EADDRINUSE else error.strerror
        raise ParamsError(f"--http-port: cannot listen on {http_port}: {reason}. Choose another port.") from None
    finally:
        for session in sessions:
            session.stop()
