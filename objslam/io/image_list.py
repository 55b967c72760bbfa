"""Image lists in TUM format (rgb.txt, depth.txt). Each line is "stamp relative/path" or a comment after '#'."""

from pathlib import Path

import numpy as np

from objslam.core.diagnostics import Ledger
from objslam.core.types import Images
from objslam.errors import LogError
from objslam.io.safe_paths import Inside
from objslam.io.text import drop_rows, in_order, parse_numbers, read_lines


def read_images(path: Path, ledger: Ledger) -> Images:
    """Return the timestamps (s) and paths of an image list, without opening the images. Raises LogError if no line is left.

    A line is dropped and counted if it is malformed or out of time order. A line is also dropped if its image is missing,
    not a regular file, or outside the folder of the list.
    """
    inside = Inside(path.parent)
    name = path.name
    stamps, files, places, gone = [], [], [], 0
    lines = read_lines(path, ledger)
    for number, text in lines:
        place = f"{path}:{number}"
        first, *rest = text.split(maxsplit=1)
        stamp = parse_numbers([first])
        if stamp is None or not np.isfinite(stamp[0]) or not rest:
            ledger.drop(f'{name} line that is not "stamp path"', where=place)
            continue
        relative = Path(rest[0])
        file = path.parent / relative
        outside = relative.is_absolute() or ".." in relative.parts
        reason = "leaves the folder" if outside else inside.reason_against(file)
        gone += reason == "leaves the folder"
        if reason is not None:
            ledger.drop(f"{name} line whose file {reason}", where=place)
            continue
        stamps.append(stamp[0])
        files.append(file)
        places.append(place)
    times = np.array(stamps, dtype=np.float64)
    forward = in_order(times)
    drop_rows(f"{name} line with a stamp that repeats or goes back", ~forward, places, ledger)
    if not forward.any():
        state = f"none of its {len(lines)} lines leads to an image" if lines else "nothing in it"
        hint = 'a line is "stamp path", the path relative to this file'
        if gone:
            hint = "images outside the log, also behind a link, are not read: copy them into the log (cp -r, or cp -rl)"
        raise LogError(state, where=str(path), hint=hint)
    return Images(times[forward], tuple(files[i] for i in np.flatnonzero(forward)))


def write_images(images: Images, path: Path) -> None:
    """Write an image list. The images must be in the folder of the list, because the written paths are relative to it."""
    pairs = zip(images.stamps.tolist(), images.paths, strict=True)
    text = "".join(f"{stamp!r} {file.relative_to(path.parent).as_posix()}\n" for stamp, file in pairs)
    path.write_text("# stamp path\n" + text, encoding="utf-8")
