"""The local server: who may ask, and which pictures it serves."""

import secrets
from http.cookies import CookieError, SimpleCookie
from typing import Any
from urllib.parse import parse_qs, urlsplit

from fastapi import FastAPI, HTTPException
from fastapi.responses import FileResponse, Response

from scenefuse.core.stage import StageError
from scenefuse.pick.session import Session

HOST = "127.0.0.1"


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
        asked = parse_qs(scope["query_string"].decode("latin-1")).get("token", [""])[0]
        by_address = scope["type"] == "http" and self._is_token(asked)
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
    """Serve the photos of a session as tiles and thumbnails, and its overlays, all by number: no address is a path."""
    forever = {"Cache-Control": "private, max-age=86400"}

    @app.get("/tile/{board}/{number}/{zoom}/{column}/{row}")
    def tile(board: int, number: int, zoom: int, column: int, row: int) -> Response:
        try:
            content = session.tiles.tile(session.photo(board, number), zoom, column, row)
        except (IndexError, StageError) as error:
            raise HTTPException(404) from error
        return Response(content, media_type="image/jpeg", headers=forever)

    @app.get("/thumbnail/{board}/{number}")
    def thumbnail(board: int, number: int) -> FileResponse:
        try:
            path, _ = session.thumbnails.get(session.photo(board, number))
        except (IndexError, StageError, OSError) as error:
            raise HTTPException(404) from error
        return FileResponse(path, media_type="image/jpeg", headers=forever)

    @app.get("/overlay/{number}")
    def overlay(number: int) -> Response:
        try:
            return Response(session.picture_of(number), media_type="image/png", headers=forever)
        except KeyError as error:
            raise HTTPException(404) from error
