"""Files that appear once they are complete: an interrupted program leaves no half of one."""

from __future__ import annotations

import contextlib
import importlib.util
import os
from collections.abc import Iterator
from pathlib import Path

from mjx_drax.errors import DraxError, shown


def file_path(path: object) -> Path:
    """The path of a file or folder, `~` being the user's home.

    Raises:
        DraxError: it is no path.
    """
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
    partial = target.with_name(f".{target.stem}.{os.getpid()}.partial{target.suffix}")
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        yield partial
        os.replace(partial, target)
    except OSError as error:
        reason = error.strerror or error
        raise DraxError(f"cannot write {str(target)!r}: {reason}. Choose another place.") from error
    finally:
        with contextlib.suppress(OSError):
            partial.unlink(missing_ok=True)


def require(package: str, extra: str, purpose: str) -> None:
    """Complain about an optional package that is not installed; call it before a long computation.

    Raises:
        DraxError: naming the command that installs it.
    """
    if importlib.util.find_spec(package) is None:
        raise DraxError(
            f'{purpose} needs {package}, which is not installed: pip install "mjx-drax[{extra}]".'
        )
