"""Ctrl-C in a diagnosis: what has been found is kept."""

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType

__all__ = ["Stop"]


class Stop:
    """Whether Ctrl-C was pressed.

    Among refits, which may take long, it ends the one under way. Elsewhere what is under way goes on to its end, of
    which the rest has need, and no refit begins after it. A second Ctrl-C ends all.
    """

    def __init__(self) -> None:
        self._pressed = False
        self._refitting = False

    def is_set(self) -> bool:
        """Whether it was."""
        return self._pressed

    @contextmanager
    def listening(self) -> Iterator[None]:
        """Take Ctrl-C for itself where Python's own handler would: in the main thread, where nobody else does."""
        mine = threading.current_thread() is threading.main_thread()
        if not mine or signal.getsignal(signal.SIGINT) is not signal.default_int_handler:
            yield
            return
        signal.signal(signal.SIGINT, self._press)
        try:
            yield
        finally:
            signal.signal(signal.SIGINT, signal.default_int_handler)

    @contextmanager
    def refitting(self) -> Iterator[None]:
        """Ctrl-C ends what is within, and is remembered."""
        self._refitting = True
        try:
            yield
        except KeyboardInterrupt:
            if self._pressed:
                raise
            self._pressed = True
        finally:
            self._refitting = False

    def _press(self, number: int, frame: FrameType | None) -> None:
        if self._refitting or self._pressed:
            raise KeyboardInterrupt
        self._pressed = True
