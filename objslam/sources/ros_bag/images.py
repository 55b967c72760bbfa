"""Extract the images of a bag into files."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from itertools import compress
from pathlib import Path
from typing import Any

import numpy as np

from objslam.core.diagnostics import Ledger
from objslam.core.types import Images
from objslam.errors import LogError
from objslam.io.text import count_drops, in_order
from objslam.ros.bag.recording import Recording, read_messages
from objslam.ros.bag.records import Connection, FileReport
from objslam.ros.messages.decode import DecodeError, make_decoder, read_head
from objslam.ros.messages.images import image_file


def extract_images(recording: Recording, folders: Mapping[str, tuple[Path, bool]], ledger: Ledger) -> dict[str, Images]:
    """Write the images of topics into files, and return the written images by topic.

    folders: the target folder of each topic, and whether the topic is depth. JPEG and PNG data is copied. Other images are
    written as PNG. Depth is written as 16 bit PNG in `DEPTH_SCALE` units per metre, with 0 for unknown depth. The name of a
    file is its stamp. Images that cannot be decoded, or whose stamp repeats or goes back, are dropped and counted.
    Only one image is in memory at a time. Raises LogError if a file cannot be written.
    """
    written: dict[str, dict[int, Path]] = {topic: {} for topic in folders}
    decoders: dict[int, tuple[Connection, Callable[[bytes], Any]]] = {}
    reports: list[FileReport] = []
    for folder, _ in folders.values():
        with _writing("the folder for images cannot be made", folder):
            folder.mkdir(parents=True, exist_ok=True)
    for connection, logged, data in read_messages(recording, lambda connection: connection.topic in folders, reports):
        folder, depth = folders[connection.topic]
        place = f"{connection.topic} at {logged / 1e9:.3f} s"
        try:
            if id(connection) not in decoders:
                decoders[id(connection)] = connection, make_decoder(connection)
            stamp = read_head(data, connection.encoding)[0] or logged
            if stamp in written[connection.topic]:
                ledger.drop("image with a stamp that repeats", where=place)
                continue
            message = decoders[id(connection)][1](data)
            content, ending = image_file(message, depth)
        except DecodeError as error:
            ledger.drop(f"image that cannot be decoded ({error})", where=place)
            continue
        path = folder / f"{stamp // 10**9}.{stamp % 10**9:09d}{ending}"
        with _writing("an image cannot be written", path):
            path.write_bytes(content)
        written[connection.topic][stamp] = path
    found = {}
    for topic, paths in written.items():
        seconds = np.array(list(paths), dtype=np.int64) / 1e9
        forward = in_order(seconds)
        late = (f"{topic} at {stamp:.3f} s" for stamp in seconds[~forward].tolist())
        count_drops("image with a stamp that goes back", int((~forward).sum()), late, ledger)
        if forward.any():
            found[topic] = Images(seconds[forward], tuple(compress(paths.values(), forward)))
    return found


@contextmanager
def _writing(what: str, path: Path) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        raise LogError(f"{what}: {error.strerror or error}", where=str(path)) from error
