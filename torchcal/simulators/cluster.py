"""Work on a Dask cluster whose futures always end.

The executor of a Dask client fetches a result as soon as its task is finished. If the worker dies that holds the result
and the task then fails elsewhere, it tells nobody, and who waits for that future waits for ever.
"""

from collections.abc import Callable
from concurrent.futures import Executor, Future
from typing import Any

__all__ = ["submit"]


def submit(executor: Executor, function: Callable[..., Any], *args: Any) -> "Future[Any]":
    """As ``executor.submit(function, *args)``, by the client itself where the executor is one of Dask's."""
    client, options = getattr(executor, "_client", None), getattr(executor, "_kwargs", None)
    if client is None or options is None:
        return executor.submit(function, *args)
    if getattr(executor, "_shutdown", False):
        raise RuntimeError("cannot schedule new futures after shutdown")
    remote = client.submit(function, *args, **options)
    executor._futures.add(remote)  # type: ignore[attr-defined]  # which its shutdown cancels, or waits for
    future: Future[Any] = Future()

    async def hand_over() -> None:
        value, error = None, None
        try:
            value = await remote
        except BaseException as raised:  # whatever ends it, who waits must hear of it
            error = raised
        if remote.cancelled():
            future.cancel()
        if not future.set_running_or_notify_cancel():
            return
        if error is None:
            future.set_result(value)
        else:
            future.set_exception(error)

    def cancel(future: "Future[Any]") -> None:
        if future.cancelled() and not remote.cancelled():
            remote.cancel()

    future.add_done_callback(cancel)
    client.loop.add_callback(hand_over)
    return future
