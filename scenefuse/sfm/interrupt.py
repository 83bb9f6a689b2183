"""Long COLMAP calls that a signal can end."""

import threading
from collections.abc import Callable
from typing import Any

import pycolmap


def cancellable(function: Callable[..., Any], *args: Any, **kwargs: Any) -> Any:
    """Call a long pycolmap function so that a signal ends it: it runs beside the main thread and is cancelled.

    A handler for SIGTERM only runs in the main thread, and only between two Python instructions.
    """
    token = pycolmap.CancellationToken()

    def cancel(worker: threading.Thread) -> None:
        token.cancel()
        worker.join()

    return _beside(lambda: function(*args, cancellation_token=token, **kwargs), cancel)


def interruptible(function: Callable[[], Any]) -> Any:
    """The same for one that takes no token: a signal leaves it behind, and it ends with the process."""
    return _beside(function, lambda worker: None)


def _beside(function: Callable[[], Any], leave: Callable[[threading.Thread], None]) -> Any:
    """What a function returns or raises beside the main thread; `leave` is called when a signal comes."""
    outcome: dict[str, Any] = {}

    def work() -> None:
        try:
            outcome["result"] = function()
        except BaseException as error:
            outcome["error"] = error

    worker = threading.Thread(target=work, daemon=True)
    worker.start()
    try:
        while worker.is_alive():
            worker.join(0.2)
    except BaseException:
        leave(worker)
        raise
    if "error" in outcome:
        raise outcome["error"]
    return outcome["result"]
