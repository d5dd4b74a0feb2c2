"""Files that are written whole or not at all."""

import contextlib
import os
import stat
import tempfile
from collections.abc import Iterator
from pathlib import Path

from torchcal.errors import DomainError

__all__ = ["check_target", "replacing"]


def check_target(path: str | os.PathLike[str]) -> Path:
    """The path of a file that can be written, checked before anything is computed for it.

    Raises:
        DomainError: If it is no path, its folder does not exist, or it is a folder itself.
    """
    if not isinstance(path, str | os.PathLike):
        raise DomainError(f"Expected path: the name of a file. Got {type(path).__name__}.")
    target = Path(os.fspath(path))
    if not target.parent.is_dir():
        raise DomainError(
            f"Expected a file in a folder that exists. Got {os.fspath(path)!r}: there is no folder "
            f"{str(target.parent)!r}. Make it first, or give another one."
        )
    if target.is_dir():
        raise DomainError(f"Expected the name of a file. Got the folder {os.fspath(path)!r}. Add a name to it.")
    return target


@contextlib.contextmanager
def replacing(path: str | os.PathLike[str]) -> Iterator[Path]:
    """An empty file beside ``path`` to write to, which takes its place in the end, or goes where something failed.

    Raises:
        DomainError: If the folder does not exist.
    """
    target = check_target(path)
    handle, name = tempfile.mkstemp(prefix=target.name[:100], suffix=".part", dir=target.parent)
    os.close(handle)
    temporary = Path(name)
    os.umask(mask := os.umask(0o077))  # it cannot be read without being set
    mode = stat.S_IMODE(target.stat().st_mode) if target.exists() else 0o666 & ~mask
    try:
        yield temporary
        with temporary.open("rb+") as file:
            os.fsync(file.fileno())  # on the disk before the old one is gone
        temporary.chmod(mode)
        temporary.replace(target)
    finally:
        temporary.unlink(missing_ok=True)
