"""The command that opens the page, and its local server: who may ask, and which pictures it serves."""

import secrets
import socket
import threading
import webbrowser
from http.cookies import CookieError, SimpleCookie
from pathlib import Path
from typing import Any
from urllib.parse import parse_qs, urlsplit

import tyro
from fastapi import FastAPI, HTTPException
from fastapi.responses import FileResponse, Response
from nicegui import app, ui

from scenefuse.core.stage import StageError
from scenefuse.pick.page import Page
from scenefuse.pick.session import Session

HOST = "127.0.0.1"


def pick(
    *, object: str, configfile: tuple[Path, ...] = (), port: int = 0, no_browser: tyro.conf.UseCounterAction[int] = 0
) -> None:
    """Click what an object is in its photos, and points in its scene's, in a page of this machine's browser.

    The page writes the tables that the workflow reads: columns `prompts` and `fiducials` of the table of objects, and
    `lengths` of the table of scenes. Run it in the working directory of the workflow, with the same settings
    files; Ctrl-C ends it.

    Args:
        object: name of the object, as in the table of objects.
        configfile: settings, one file or several, as given to snakemake; where it is left out, the shipped ones, or
            with the command `scenefuse pick` the project's config/config.yaml.
        port: of the page on this machine; 0 takes a free one.
        no_browser: print the address only.

    Raises:
        StageError: settings, tables or photos are wrong, or the port cannot be used.
    """
    session = Session(object, configfile)
    port, token = _free_port(port), secrets.token_urlsafe(16)
    address = f"http://{HOST}:{port}/?token={token}"
    app.add_middleware(Guard, token=token, port=port)
    add_pictures(app, session)

    @ui.page("/", title=f"{object}: click")
    async def page() -> None:
        opened = Page(session)
        await ui.context.client.connected()
        await opened.begin()

    def announce() -> None:
        print(f"{address}\nOpen this address in a browser of this machine; Ctrl-C ends the page.", flush=True)
        if not no_browser:
            threading.Thread(target=webbrowser.open, args=(address,), daemon=True).start()

    app.on_startup(session.start)
    app.on_startup(announce)
    app.on_shutdown(session.close)
    try:
        ui.run(
            host=HOST,
            port=port,
            show=False,
            reload=False,
            show_welcome_message=False,
            title="scenefuse",
            favicon="🖱",
            timeout_graceful_shutdown=1,
        )
    except SystemExit as end:
        session.leave(end.code if isinstance(end.code, int) else 1)
        raise


def _free_port(wanted: int) -> int:
    """A port that nothing listens at, the wanted one if it is not 0."""
    with socket.socket() as probe:
        # As the server does: a port that another one has just left is free.
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((HOST, wanted))
        except (OSError, OverflowError) as error:
            raise StageError(
                f"--port {wanted} cannot be used ({error}); give another, or none for a free one"
            ) from None
        return probe.getsockname()[1]


class Guard:
    """Lets through requests of this machine's browser that know the token: in the address, then by a cookie.

    A request has to be addressed to this machine, so that no other site's name can be made to point here, and a
    websocket has to come from the page itself. An ASGI middleware.
    """

    def __init__(self, app: Any, token: str, port: int) -> None:
        self._app, self._token, self._cookie = app, token, f"scenefuse_pick_{port}"
        self._hosts = {f"{HOST}:{port}", f"localhost:{port}"}

    async def __call__(self, scope: Any, receive: Any, send: Any) -> None:
        """Serve a request, or refuse it with 403."""
        if scope["type"] not in ("http", "websocket"):
            await self._app(scope, receive, send)
            return
        headers = {key.decode("latin-1"): value.decode("latin-1") for key, value in scope["headers"]}
        given = parse_qs(scope["query_string"].decode("latin-1")).get("token", [""])[0]
        by_address = scope["type"] == "http" and self._is_token(given)
        if not self._is_local(headers) or not (by_address or self._is_token(self._in_cookie(headers))):
            await _refuse(scope, send)
            return

        async def send_with_cookie(message: Any) -> None:
            if by_address and message["type"] == "http.response.start":
                value = f"{self._cookie}={self._token}; Path=/; HttpOnly; SameSite=Strict"
                message["headers"] = [*message["headers"], (b"set-cookie", value.encode())]
            if message["type"] == "http.response.start":
                message["headers"] = [*message["headers"], (b"referrer-policy", b"no-referrer")]
            await send(message)

        await self._app(scope, receive, send_with_cookie)

    def _is_local(self, headers: dict[str, str]) -> bool:
        origin = headers.get("origin")
        return headers.get("host") in self._hosts and (origin is None or urlsplit(origin).netloc in self._hosts)

    def _is_token(self, text: str) -> bool:
        return secrets.compare_digest(text.encode(), self._token.encode())

    def _in_cookie(self, headers: dict[str, str]) -> str:
        try:
            found = SimpleCookie(headers.get("cookie", "")).get(self._cookie)
        except CookieError:
            return ""
        return found.value if found else ""


async def _refuse(scope: Any, send: Any) -> None:
    if scope["type"] == "websocket":
        await send({"type": "websocket.close", "code": 1008})
        return
    text = b"Open the address that scenefuse pick printed: it ends with the token."
    await send({"type": "http.response.start", "status": 403, "headers": [(b"content-type", b"text/plain")]})
    await send({"type": "http.response.body", "body": text})


def add_pictures(app: FastAPI, session: Session) -> None:
    """Serve the photos of a session as tiles and thumbnails, by number: no address is a path."""
    forever = {"Cache-Control": "private, max-age=86400"}

    @app.get("/tile/{table}/{number}/{zoom}/{column}/{row}")
    def tile(table: int, number: int, zoom: int, column: int, row: int) -> Response:
        try:
            content = session.tiles.tile(session.photo(table, number), zoom, column, row)
        except (IndexError, StageError) as error:
            raise HTTPException(404) from error
        return Response(content, media_type="image/jpeg", headers=forever)

    @app.get("/thumbnail/{table}/{number}")
    def thumbnail(table: int, number: int) -> FileResponse:
        try:
            path, _ = session.thumbnails.get(session.photo(table, number))
        except (IndexError, StageError) as error:
            raise HTTPException(404) from error
        return FileResponse(path, media_type="image/jpeg", headers=forever)
