"""The socket of an embedded bus: its directory, and how a program connects to it.

The errors are texts without the name of the bus, which the caller puts before them.
"""

from __future__ import annotations

import os
import select
import socket
import stat
import struct
import time
from pathlib import Path
from typing import Final

ANSWER_TIMEOUT_S: Final = 2.0
SO_TIMESTAMPNS: Final = 35
_RETRY_INTERVAL_S: Final = 0.005
_SEND_BUFFER_BYTES: Final = 1 << 18
_MAX_PATH_BYTES: Final = 107
_MAX_NAME_BYTES: Final = 15

_VERSION: Final = 2
_MAGIC: Final = b"skinbus"
_HELLO: Final = struct.Struct("<7s3BIQB")
_ANSWER: Final = struct.Struct("<7s2BQ")


class AttachError(Exception):
    """A connection to a bus could not be made.

    Attributes:
        code: The system's error number, if it tells more than the text.
    """

    def __init__(self, text: str, code: int | None = None) -> None:
        super().__init__(text)
        self.code = code


def default_directory() -> Path:
    """Returns the directory of embedded buses.

    It is `$SKINBUS_DIR`, else `$XDG_RUNTIME_DIR/skinbus`, else `/tmp/skinbus-UID`.
    """
    if own := os.environ.get("SKINBUS_DIR"):
        return Path(own)
    if runtime := os.environ.get("XDG_RUNTIME_DIR"):
        return Path(runtime) / "skinbus"
    return Path(f"/tmp/skinbus-{os.geteuid()}")


def socket_path(directory: Path, name: str) -> Path:
    """Returns the path of a bus' socket."""
    return directory / f"{name}.bus"


def check_name(name: str) -> None:
    """Checks the name of a bus.

    Raises:
        ValueError: No bus can have this name.
    """
    is_short = 1 <= len(os.fsencode(name)) <= _MAX_NAME_BYTES
    if not is_short or name in (".", "..") or any(c in "/:" or c.isspace() or not c.isprintable() for c in name):
        raise ValueError(
            f"{name!r} is not a valid bus name: use 1 to 15 bytes without spaces, '/' or ':', and not '.' or '..'"
        )


def check_private(directory: Path) -> None:
    """Checks that only this user has access to a directory.

    Raises:
        FileNotFoundError: It does not exist.
        AttachError: It belongs to another user, others have access to it, or it is not a directory. A symbolic link
            is not followed.
    """
    advice = "set SKINBUS_DIR to a directory of your own"
    try:
        descriptor = os.open(directory, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW | os.O_CLOEXEC)
    except FileNotFoundError:
        raise
    except OSError as error:
        raise AttachError(
            f"cannot use the directory {directory} for embedded buses: {error.strerror}; {advice}"
        ) from error
    try:
        about = os.fstat(descriptor)
    finally:
        os.close(descriptor)
    if about.st_uid != os.geteuid():
        raise AttachError(
            f"the directory {directory} for embedded buses belongs to user {about.st_uid}, but this program runs as "
            f"user {os.geteuid()}: {advice}"
        )
    mode = stat.S_IMODE(about.st_mode)
    if mode & 0o077:
        raise AttachError(
            f"the directory {directory} for embedded buses has mode {mode:04o}, so other users can open it: run "
            "`chmod 700` on it, or set SKINBUS_DIR to another directory"
        )


def attach(
    directory: Path,
    name: str,
    *,
    own_frames: bool,
    fd: bool,
    error_mask: int,
    receive_buffer: int,
    filters: bytes,
) -> tuple[socket.socket, int]:
    """Connects to a bus, sends the hello and receives the answer.

    Returns:
        A socket that does not block and receives time stamps, and the granted receive buffer in bytes.

    Raises:
        AttachError: The bus is not served, its directory is not private to this user, or the server refused, ended or
            did not answer within 2 s.
    """
    path = socket_path(directory, name)
    if len(os.fsencode(path)) > _MAX_PATH_BYTES:
        raise AttachError(
            f"the path {path} is too long for a Unix socket, which allows {_MAX_PATH_BYTES} bytes: set SKINBUS_DIR to "
            "a shorter path"
        )
    hello = _HELLO.pack(_MAGIC, _VERSION, own_frames, fd, error_mask, receive_buffer, 0) + filters
    client = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    try:
        check_private(directory)
        client.setblocking(False)
        client.setsockopt(socket.SOL_SOCKET, SO_TIMESTAMPNS, 1)
        client.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _SEND_BUFFER_BYTES)
        _connect(client, path)
        return client, _exchange_hello(client, path, hello)
    except (FileNotFoundError, ConnectionRefusedError) as error:
        client.close()
        raise AttachError(
            f"no embedded bus is served at {path}: start `vcan-setup serve {name}`, or set SKINBUS_DIR to the "
            "directory of its server"
        ) from error
    except ConnectionError as error:
        client.close()
        raise AttachError(_no_room(path)) from error
    except OSError as error:
        client.close()
        raise AttachError(f"cannot attach to {path}: {error.strerror}", error.errno) from error
    except BaseException:
        client.close()
        raise


def _connect(client: socket.socket, path: Path) -> None:
    """Connects, and waits while the server's list of new connections is full."""
    end = time.monotonic() + ANSWER_TIMEOUT_S
    while True:
        try:
            return client.connect(os.fsencode(path))
        except BlockingIOError:
            if time.monotonic() > end:
                raise _no_answer(path) from None
            time.sleep(_RETRY_INTERVAL_S)


def _exchange_hello(client: socket.socket, path: Path, hello: bytes) -> int:
    """Sends the hello and returns the granted receive buffer in bytes."""
    client.send(hello, socket.MSG_NOSIGNAL)
    if not wait(client, select.POLLIN, ANSWER_TIMEOUT_S):
        raise _no_answer(path)
    answer = client.recv(64)
    if not answer:
        raise AttachError(_no_room(path))
    if len(answer) != _ANSWER.size or not answer.startswith(_MAGIC):
        raise AttachError(f"the server at {path} does not serve an embedded bus")
    _, version, result, granted = _ANSWER.unpack(answer)
    if version != _VERSION or result != 0:
        raise AttachError(
            f"the server at {path} refused the connection: it uses version {version}, this package uses version "
            f"{_VERSION}: use both from the same build"
        )
    return int(granted)


def is_served(path: Path) -> bool:
    """Returns whether a server accepts connections at a socket. A killed server leaves its socket behind."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as client:
        client.setblocking(False)
        try:
            client.connect(os.fsencode(path))
        except BlockingIOError:
            return True
        except OSError:
            return False
        return True


def wait(client: socket.socket, events: int, timeout: float | None) -> bool:
    """Waits until a socket is ready, or for `timeout` seconds. Returns whether it is ready.

    Raises:
        ValueError: The socket is closed.
    """
    poll = select.poll()
    poll.register(client, events)
    return bool(poll.poll(None if timeout is None else timeout * 1000))


def _no_answer(path: Path) -> AttachError:
    return AttachError(f"the server at {path} did not answer within {ANSWER_TIMEOUT_S:g} s: check that it runs")


def _no_room(path: Path) -> str:
    return (
        f"the server at {path} ended, or has no file descriptors left: start it again, end other clients, or raise "
        "`ulimit -Hn` where it is started"
    )
