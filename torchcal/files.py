"""Files that are written whole or not at all."""

import contextlib
import os
import secrets
import stat
from collections.abc import Iterator
from pathlib import Path

from torchcal.errors import DomainError

__all__ = ["check_target", "replacing"]


def check_target(path: str | os.PathLike[str]) -> Path:
    """The path of a file that can be written, checked before anything is computed for it.

    Raises:
        DomainError: If it is no path, its folder does not exist or cannot be written to, or it is a folder itself.
    """
    if not isinstance(path, str | os.PathLike):
        raise DomainError(f"Expected path: the name of a file. Got {type(path).__name__}.")
    target = Path(os.fspath(path))
    if not target.parent.is_dir():
        raise DomainError(
            f"Expected a file in a folder that exists. Got {os.fspath(path)!r}: there is no folder "
            f"{str(target.parent)!r}. Make it first, or give another one."
        )
    if not os.access(target.parent, os.W_OK):
        raise DomainError(
            f"Expected a folder that can be written to. Got {str(target.parent)!r}, which cannot. Give another one."
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
    temporary = target.with_name(f"{target.name[:100]}{secrets.token_hex(6)}.part")
    mode = stat.S_IMODE(target.stat().st_mode) if target.exists() else None
    os.close(os.open(temporary, os.O_CREAT | os.O_EXCL | os.O_WRONLY, 0o666 if mode is None else 0o600))
    try:
        yield temporary
        with temporary.open("rb+") as file:
            os.fsync(file.fileno())  # on the disk before the old one is gone
        if mode is not None:
            temporary.chmod(mode)
        temporary.replace(target)
    finally:
        temporary.unlink(missing_ok=True)
