"""Lock of a folder against concurrent trainings."""

import contextlib
import errno
import fcntl
import os
import socket
from collections.abc import Callable, Iterator
from pathlib import Path

from jaxdrones.errors import UserError

_NAME = ".lock"
_NO_LOCKS = (errno.ENOLCK, errno.ENOSYS, errno.EOPNOTSUPP)  # of file systems without locks


@contextlib.contextmanager
def locked(folder: Path, warn: Callable[[str], None]) -> Iterator[None]:
    """Context with an exclusive lock of the folder; an empty folder is removed at its end.

    The operating system releases the lock when its process ends. On NFS the lock holds for all machines. On a file
    system without locks nothing is locked, and `warn` is called with a message.
    """
    made = [path for path in (folder, *folder.parents) if not path.exists()]
    folder.mkdir(parents=True, exist_ok=True)
    try:
        descriptor = _locked_file(folder, warn)
        try:
            yield
        finally:
            (folder / _NAME).unlink(missing_ok=True)  # while locked
            os.close(descriptor)
    finally:
        with contextlib.suppress(OSError):
            for path in made:
                path.rmdir()


def _locked_file(folder: Path, warn: Callable[[str], None]) -> int:
    """Descriptor of the locked file, which names the locking process."""
    file = folder / _NAME
    while True:
        try:
            descriptor = os.open(file, os.O_RDWR | os.O_CREAT, 0o666)
        except OSError as error:
            raise OSError(error.errno, error.strerror, str(folder)) from error
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            holder = os.pread(descriptor, 300, 0).decode(errors="replace").strip() or "another process"
            os.close(descriptor)
            raise UserError(
                f"{folder} is in use by {holder}, which trains into it; wait for it, or choose another --output"
            ) from None
        except OSError as error:
            if error.errno not in _NO_LOCKS:
                os.close(descriptor)
                raise OSError(error.errno, error.strerror, str(folder)) from error
            warn(f"the file system of {folder} has no locks; start no second training into this folder")
        if _is_same(descriptor, file):  # not so if its last holder removed it meanwhile
            os.truncate(descriptor, 0)
            os.pwrite(descriptor, f"process {os.getpid()} on {socket.gethostname()}".encode(), 0)
            return descriptor
        os.close(descriptor)


def _is_same(descriptor: int, file: Path) -> bool:
    """Whether a path still refers to the open file."""
    try:
        return os.path.samestat(os.fstat(descriptor), os.stat(file))
    except FileNotFoundError:
        return False
