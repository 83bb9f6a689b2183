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
    outcome: dict[str, Any] = {}

    def work() -> None:
        try:
            outcome["result"] = function(*args, cancellation_token=token, **kwargs)
        except BaseException as error:
            outcome["error"] = error

    worker = threading.Thread(target=work)
    worker.start()
    try:
        while worker.is_alive():
            worker.join(0.2)
    except BaseException:
        token.cancel()
        worker.join()
        raise
    if "error" in outcome:
        raise outcome["error"]
    return outcome["result"]
