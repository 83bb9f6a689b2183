"""The command that opens the page, and its local server: who may ask, and which pictures it serves."""

import os
import secrets
import socket
import threading
import webbrowser
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any
from urllib.parse import parse_qs, urlsplit

import nicegui
import tyro
from fastapi import FastAPI, HTTPException
from fastapi.responses import FileResponse, HTMLResponse, PlainTextResponse, Response
from nicegui import app, ui

from scenefuse.core.machine import has_screen
from scenefuse.core.stage import StageError
from scenefuse.pick.page import ASSETS, Page
from scenefuse.pick.session import Session

HOST = "127.0.0.1"


SAFETY = {
    "content-security-policy": "frame-ancestors 'none'",
    "x-frame-options": "DENY",
    "cross-origin-opener-policy": "same-origin",
    "referrer-policy": "no-referrer",
}


def pick(
    *,
    object: str | None = None,
    configfile: tuple[Path, ...] = (),
    port: int = 0,
    no_browser: Annotated[tyro.conf.UseCounterAction[int], tyro.conf.arg(help_behavior_hint="")] = 0,
) -> None:
    """Click what an object is in its photos, and points in its scene's, in a page of this machine's browser.

    The page writes the tables that the workflow reads: columns `prompts` and `fiducials` of the table of objects, and
    `lengths` of the table of scenes. Run it in the folder of the project; its button Done ends it.

    Args:
        object: name of the object, as in the table of objects; where it is left out, the only one.
        configfile: settings, one file or several, as given to snakemake; where it is left out, the shipped ones, or
            with the command `scenefuse pick` the project's config/config.yaml.
        port: of the page on this machine; 0 takes a free one.
        no_browser: print an address to open, which opens the page once.

    Raises:
        StageError: settings, tables or photos are wrong, or the port cannot be used.
    """
    session = Session(object, configfile)
    port, shows = _free_port(port), has_screen() and not no_browser
    entrance = Entrance(port, Path(f"results/pick/open-{port}.html"), print if not shows else lambda _: None)
    app.add_middleware(Guard, entrance=entrance, key=session.key, port=port)
    app.config.socket_io_js_query_params["key"] = session.key
    add_pictures(app, session)

    @ui.page("/", title=f"{session.name}: click")
    async def page() -> None:
        opened = Page(session)
        await ui.context.client.connected()
        await opened.begin()

    def announce() -> None:
        if shows:
            print(f"The page opens in a browser, or by {entrance.file}; clicks are saved, Done ends it.", flush=True)
            threading.Thread(target=webbrowser.open, args=(entrance.file.resolve().as_uri(),), daemon=True).start()
        else:
            print(f"{entrance.address}\nOpen this address in a browser of this machine, or of one from which", end=" ")
            print(f"ssh -L {port}:{HOST}:{port} leads here; clicks are saved, Done ends it.", flush=True)

    app.on_startup(session.start)
    app.on_startup(announce)
    app.on_shutdown(session.close)
    app.on_shutdown(entrance.close)
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
    session.leave(0)


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


class Entrance:
    """The way to the page: a token that leads in once, in a file that only this user can read; then comes another one.

    Attributes:
        secret: what the token is traded for.
        address: with the token, after #: no browser sends it to a server, and the page takes it away at once.
        file: an HTML page that leads to the address.
    """

    def __init__(self, port: int, file: Path, on_new: Callable[[str], Any]) -> None:
        """Write the file; `on_new` gets each further address."""
        self.secret, self.file, self._port, self._on_new = secrets.token_urlsafe(), file, port, on_new
        self._renew()

    def enter(self, token: str) -> str | None:
        """The secret for the token, once; None for anything else."""
        if not _same(token, self._token):
            return None
        self._renew()
        self._on_new(f"To open the page again: {self.address}")
        return self.secret

    def close(self) -> None:
        """Remove the file."""
        self.file.unlink(missing_ok=True)

    def _renew(self) -> None:
        self._token = secrets.token_urlsafe()
        self.address = f"http://{HOST}:{self._port}/#{self._token}"
        self.file.parent.mkdir(parents=True, exist_ok=True)
        written = self.file.with_suffix(".tmp")
        written.unlink(missing_ok=True)
        with open(os.open(written, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600), "w") as file:
            file.write(f'<!doctype html><meta http-equiv="refresh" content="0; url={self.address}">')
        written.replace(self.file)


class Guard:
    """Serves the page to who has the secret, photos and the websocket to who has the page's key. An ASGI middleware.

    There is no cookie: browsers send those to every port of this machine, other users' servers included. A request has
    to be addressed to this machine, so that no other site's name can be made to point here.
    """

    def __init__(self, app: Any, entrance: Entrance, key: str, port: int) -> None:
        self._app, self._entrance, self._key = app, entrance, key
        self._hosts = {f"{HOST}:{port}", f"localhost:{port}"}
        # NiceGUI's own scripts, the same for everybody.
        self._public = f"/_nicegui/{nicegui.__version__}/"

    async def __call__(self, scope: Any, receive: Any, send: Any) -> None:
        """Serve a request, or refuse it with 403."""
        if scope["type"] not in ("http", "websocket"):
            await self._app(scope, receive, send)
            return
        headers = {key.decode("latin-1"): value.decode("latin-1") for key, value in scope["headers"]}
        answer = self._answer(scope, headers) if self._is_local(headers) else _refusal()

        async def send_safely(message: Any) -> None:
            if message["type"] == "http.response.start":
                message["headers"] = [*message["headers"], *((k.encode(), v.encode()) for k, v in SAFETY.items())]
            await send(message)

        if answer is not None and scope["type"] == "websocket":
            await send({"type": "websocket.close", "code": 1008})
        else:
            await (answer or self._app)(scope, receive, send_safely)

    def _answer(self, scope: Any, headers: dict[str, str]) -> Response | None:
        """What a request gets from the guard; None where it may pass."""
        path, given = scope["path"], headers.get("x-scenefuse", "")
        if scope["type"] == "http" and path == "/enter":
            secret = self._entrance.enter(given)
            return _refusal() if secret is None else PlainTextResponse(secret, headers={"cache-control": "no-store"})
        if path == "/" and not given:
            return HTMLResponse((ASSETS / "door.html").read_text(), headers={"cache-control": "no-store"})
        if path == "/":
            return None if _same(given, self._entrance.secret) else _refusal()
        key = parse_qs(scope["query_string"].decode("latin-1")).get("key", [""])[0]
        return None if path.startswith(self._public) or _same(key, self._key) else _refusal()

    def _is_local(self, headers: dict[str, str]) -> bool:
        origin = headers.get("origin")
        return headers.get("host") in self._hosts and (origin is None or urlsplit(origin).netloc in self._hosts)


def _refusal() -> Response:
    return PlainTextResponse("Open the page by what scenefuse pick printed last.", 403)


def _same(given: str, secret: str) -> bool:
    return secrets.compare_digest(given.encode(), secret.encode())


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
