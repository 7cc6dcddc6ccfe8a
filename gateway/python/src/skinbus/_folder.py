"""A folder that is removed whatever happens."""

from __future__ import annotations

import contextlib
import os
import shutil
import subprocess
import tempfile
from pathlib import Path

# The path of a Unix socket has at most 107 bytes; "/skinbus-12345678/bus/" and the name of a bus take up to 42 of them.
_MAX_ROOT = 65
# Makes the folder, writes its path, and waits for the end of its input.
_SCRIPT = (
    'folder=$(mktemp -d "$1/skinbus-XXXXXXXX") || exit; printf %s "$folder"; exec >&-; read -r line; rm -rf "$folder"'
)


class PrivateFolder:
    """A temporary folder that only this user can read.

    A shell makes it, and waits for the end of a pipe whose other end this process has, and hands to the processes that
    use the folder. So it removes the folder after the last of them, even if SIGKILL ended this process.

    Args:
        for_sockets: Make it in /tmp if the usual place has a path too long for sockets.

    Raises:
        OSError: The folder cannot be made.
    """

    def __init__(self, *, for_sockets: bool = True) -> None:
        root = tempfile.gettempdir()
        if for_sockets and len(os.fsencode(root)) > _MAX_ROOT:
            root = "/tmp"
        reader, self._writer = os.pipe()
        self._is_open = True
        try:
            self._watcher = subprocess.Popen(
                ["/bin/sh", "-c", _SCRIPT, "sh", root],
                stdin=reader,
                stdout=subprocess.PIPE,
                stderr=subprocess.PIPE,
                start_new_session=True,
            )
            assert self._watcher.stdout is not None
            assert self._watcher.stderr is not None
            with self._watcher.stdout as output, self._watcher.stderr as errors:
                self.path = Path(os.fsdecode(output.read()))
                if self.path == Path():
                    self._watcher.wait()
                    raise OSError(os.fsdecode(errors.read()).strip() or "no temporary folder could be made")
        except BaseException:
            os.close(self._writer)
            raise
        finally:
            os.close(reader)

    @property
    def descriptor(self) -> int:
        """File descriptor that processes inherit which use the folder."""
        return self._writer

    def close(self) -> None:
        """Removes the folder. Further calls do nothing."""
        if not self._is_open:
            return
        self._is_open = False
        shutil.rmtree(self.path, ignore_errors=True)
        os.close(self._writer)
        # If a process still has the pipe, the shell waits for its end.
        with contextlib.suppress(subprocess.TimeoutExpired):
            self._watcher.wait(5.0)
