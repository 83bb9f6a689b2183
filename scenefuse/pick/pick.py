"""The command that opens the page."""

import secrets
import socket
import threading
import webbrowser
from pathlib import Path

import tyro

from scenefuse.core.stage import StageError
from scenefuse.pick.session import Session


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
        StageError: settings, tables or photos are wrong, or the page's packages are not installed.
    """
    session = Session(object, configfile)
    try:
        from nicegui import app, ui

        from scenefuse.pick.page import Page
        from scenefuse.pick.server import HOST, Guard, add_pictures
    except ImportError as error:
        raise StageError(f"the page needs NiceGUI ({error}): pip install -r envs/requirements.txt") from None
    port, token = _free_port(HOST, port), secrets.token_urlsafe(16)
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
    app.on_shutdown(lambda: [print(sentence, flush=True) for sentence in session.close()])
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


def _free_port(host: str, wanted: int) -> int:
    """A port that nothing listens at, the wanted one if it is not 0."""
    with socket.socket() as probe:
        # As the server does: a port that another one has just left is free.
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((host, wanted))
        except (OSError, OverflowError) as error:
            raise StageError(
                f"--port {wanted} cannot be used ({error}); give another, or none for a free one"
            ) from None
        return probe.getsockname()[1]
