"""Files that appear once they are complete: an interrupted program leaves no half of one.

What they will need is tried before a long computation, not found missing after it.
"""

from __future__ import annotations

import contextlib
import errno
import glob
import importlib.util
import json
import math
import os
import shutil
import socket
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from mjx_drax.base.errors import DraxError, shown


def file_path(path: object) -> Path:
    """The path of a file or folder, if it is one, `~` being the user's home."""
    try:
        target = Path(path).expanduser()  # type: ignore[arg-type]
        os.fsencode(target)
    except (TypeError, ValueError, RuntimeError) as error:
        raise DraxError(f"the path is {shown(path)}: give a text or a pathlib.Path.") from error
    if "\0" in str(target):
        raise DraxError(f"the path is {shown(path)}: remove the null character.")
    return target


@contextlib.contextmanager
def complete(path: str | os.PathLike[str], suffixes: tuple[str, ...] = ()) -> Iterator[Path]:
    """A temporary path beside `path`, which takes its place when the block ends without an error.

    Args:
        path: of the file to write; its folder is made if need be, `~` is the user's home.
        suffixes: what its name may end in; anything if empty.

    Raises:
        DraxError: it ends otherwise, or cannot be written.
    """
    target = file_path(path)
    if suffixes and target.suffix.lower() not in suffixes:
        raise DraxError(f"{target.name!r} does not end in {' or '.join(suffixes)}: rename it.")
    if target.is_dir():
        raise DraxError(f"cannot write {str(target)!r}: it is a folder; give a file in it.")
    partial = target.with_name(_partial(target, _process(os.getpid())))
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        yield partial
        with open(partial, "rb") as file:
            os.fsync(file.fileno())  # or a power cut could leave the name without the content
        os.replace(partial, target)
    except OSError as error:
        reason = error.strerror or error
        raise DraxError(f"cannot write {str(target)!r}: {reason}. Choose another place.") from error
    finally:
        with contextlib.suppress(OSError):
            partial.unlink(missing_ok=True)


def write_json(path: str | os.PathLike[str], data: Any) -> Path:
    """Write nested dicts, lists, numbers and texts as JSON; returns the path, which ends in .json.

    There may be NumPy and JAX arrays; a number that is not finite becomes null.
    """
    text = json.dumps(json_data(data), indent=2, ensure_ascii=False, allow_nan=False)
    with complete(path, (".json",)) as partial:
        # What UTF-8 cannot hold, as in some names of files, becomes an escape that JSON knows.
        partial.write_text(text + "\n", encoding="utf-8", errors="backslashreplace")
    return file_path(path)


def json_data(data: Any) -> Any:
    """The same data as JSON knows it: arrays as lists, None where a number is not finite."""
    if hasattr(data, "tolist"):  # arrays and their scalars; this room does not import NumPy
        data = data.tolist()
    if isinstance(data, dict):
        return {name: json_data(value) for name, value in data.items()}
    if isinstance(data, list | tuple):
        return [json_data(value) for value in data]
    return None if isinstance(data, float) and not math.isfinite(data) else data


def _partial(target: Path, process: str) -> str:
    """The name under which a process writes a file."""
    return f".{target.stem}.{process}.partial{target.suffix}"


def _process(number: int | str) -> str:
    """A process among those of all machines that may share a folder."""
    return f"{socket.gethostname()}-{number}"


def _remove_left_over(target: Path) -> None:
    """Remove what dead processes of this machine left of a file.

    Of processes on other machines nobody here can tell whether they are still at work.
    """
    start, end = _partial(target, _process("\0")).split("\0")
    for left in target.parent.glob(f"{glob.escape(start)}*{glob.escape(end)}"):
        number = left.name[len(start) : len(left.name) - len(end)]
        if number.isdecimal() and not _lives(int(number)):
            with contextlib.suppress(OSError):
                left.unlink()


def _lives(number: int) -> bool:
    """Whether a process of that number runs on this machine; a doubt counts as yes."""
    try:
        os.kill(number, 0)  # signal 0 is not sent: the call only looks for the process
    except ProcessLookupError:
        return False
    except (OSError, OverflowError):  # it is another user's, or no number of a process
        return True
    return True


class _Tried(Exception):
    """A file was tried and is not to be kept."""


def require_room(path: str | os.PathLike[str], size: int = 1) -> None:
    """Complain about a file that could not be written; call it before a long computation.

    It is tried, with `size` bytes, and removed. So is what killed processes left of it, while the
    files of processes that are still at work stay.

    Raises:
        DraxError: the folder cannot be made or written to, or the disk is too full.
    """
    target = Path(path).expanduser()
    _remove_left_over(target)
    with contextlib.suppress(_Tried), complete(target) as partial:
        with open(partial, "wb") as file:
            if hasattr(os, "posix_fallocate"):
                os.posix_fallocate(file.fileno(), 0, size)
            elif shutil.disk_usage(target.parent).free < size:  # macOS
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        raise _Tried


def require(package: str, extra: str, purpose: str) -> None:
    """Complain about an optional package that is missing; call it before a long computation."""
    if importlib.util.find_spec(package) is None:
        raise DraxError(
            f'{purpose} needs {package}, which is not installed: pip install "mjx-drax[{extra}]".'
        )
