"""TensorBoard's event files, written at once and without a thread; a run goes on without them."""

import socket
import struct
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO

from tensorboardX.proto import event_pb2, summary_pb2
from tensorboardX.record_writer import masked_crc32c

VERSION = "brain.Event:2"


class Events:
    """One event file. When it cannot be written, that is said once, and no more is written.

    tensorboardX's own writer has a thread that dies of a full disk, and a queue that then blocks.

    Args:
        folder: Folder of the event files.
        until: Step that the run continues from; later events of older files are hidden.
        say: Is told when writing fails.
    """

    def __init__(self, folder: Path, until: int, say: Callable[[str], None]) -> None:
        self._folder = folder
        self._say = say
        self._file: BinaryIO | None = None
        with self._optional():
            folder.mkdir(parents=True, exist_ok=True)
            name = f"events.out.tfevents.{int(time.time())}.{socket.gethostname()}"
            self._file = (folder / name).open("ab", buffering=0)
            self._write(file_version=VERSION)
            if until:
                start = event_pb2.SessionLog(status=event_pb2.SessionLog.START)
                self._write(step=until + 1, session_log=start)

    def scalars(self, step: int, values: Mapping[str, int | float]) -> None:
        """Write scalars by their names."""
        named = [summary_pb2.Summary.Value(tag=n, simple_value=v) for n, v in values.items()]
        with self._optional():
            self._write(step=step, summary=summary_pb2.Summary(value=named))

    def close(self) -> None:
        """Close the file."""
        if self._file is not None:
            self._file.close()
            self._file = None

    def _write(self, **parts: object) -> None:
        if self._file is None:
            return
        data = event_pb2.Event(wall_time=time.time(), **parts).SerializeToString()
        length = struct.pack("<Q", len(data))
        sums = (struct.pack("<I", masked_crc32c(part)) for part in (length, data))
        record = length + next(sums) + data + next(sums)
        if self._file.write(record) < len(record):
            raise OSError("only a part was written")

    @contextmanager
    def _optional(self) -> Iterator[None]:
        try:
            yield
        except OSError as error:
            self.close()
            reason = error.strerror or error
            self._say(f"{self._folder}: no more events for TensorBoard: {reason}")
