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

    Of a symbolic link what it leads to is checked, which is what `replacing` replaces.

    Raises:
        DomainError: If it is no path, its folder does not exist or cannot be written to, or it is there and no file:
            a folder, a device or a pipe.
    """
    if not isinstance(path, str | os.PathLike):
        raise DomainError(f"Expected path: the name of a file. Got {type(path).__name__}.")
    given = Path(os.fspath(path))
    if given.is_dir():
        raise DomainError(f"Expected the name of a file. Got the folder {os.fspath(path)!r}. Add a name to it.")
    target = _end_of_links(given)
    if (os.path.exists(given) or target.is_symlink()) and not os.path.isfile(given):
        raise DomainError(
            f"Expected the name of a file. Got {os.fspath(path)!r}, which is a device, a pipe or the like and would be "
            "replaced by a file. Give another name."
        )
    if not target.parent.is_dir():
        raise DomainError(
            f"Expected a file in a folder that exists. Got {os.fspath(path)!r}: there is no folder "
            f"{str(target.parent)!r}. Make it first, or give another one."
        )
    if not os.access(target.parent, os.W_OK):
        raise DomainError(
            f"Expected a folder that can be written to. Got {str(target.parent)!r}, which cannot. Give another one."
        )
    return given


def _end_of_links(path: Path) -> Path:
    """What a symbolic link leads to, also where that is not there yet; another path as it is."""
    return Path(os.path.realpath(path)) if path.is_symlink() else path


@contextlib.contextmanager
def replacing(path: str | os.PathLike[str]) -> Iterator[Path]:
    """An empty file beside ``path`` to write to, which takes its place in the end, or goes where something failed.

    A symbolic link stays one: what it leads to is replaced.

    Raises:
        DomainError: If the folder does not exist, or ``path`` is there and no file.
    """
    target = _end_of_links(check_target(path))
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
