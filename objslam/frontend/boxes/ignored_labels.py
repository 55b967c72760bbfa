"""Leave out the boxes of labels that the user does not want in the map, such as persons."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from objslam.config import Settings
from objslam.core.diagnostics import Ledger
from objslam.core.types import Log

IGNORED_LABELS = "boxes of ignored labels (rays.ignore_labels)"
"""The reason to drop boxes of labels that the user does not want in the map."""
_SHOWN = 10  # The most labels of the log in a warning. A larger value makes a longer line.


def without_ignored_labels(log: Log, settings: Settings, ledger: Ledger) -> Log:
    """Return the log without the boxes of the labels in `rays.ignore_labels`. The ledger counts them for each label.

    Frames stay, because they show what the camera did not see. The ledger warns of an ignored label that the log lacks.
    """
    wanted_out = settings.rays.ignore_labels
    if not wanted_out:
        return log
    cameras, dropped, boxes = list(log.cameras), Counter[str](), 0
    for i, one in enumerate(log.cameras):
        if one.detections is not None:
            label, names = one.detections.label, one.detections.label_names
            off = np.isin(label, [number for number, name in enumerate(names) if name in wanted_out])
            dropped.update(dict(zip(names, np.bincount(label[off], minlength=len(names)).tolist(), strict=True)))
            cameras[i] = replace(one, detections=one.detections.take(np.flatnonzero(~off))) if off.any() else one
            boxes += len(off)
    for name, count in dropped.most_common():
        ledger.drop(IGNORED_LABELS, count, f"{count} of {name}")
    ledger.drop(IGNORED_LABELS, 0, of=boxes)
    warn_of_missing_labels(wanted_out, sorted(dropped), ledger)
    return replace(log, cameras=tuple(cameras))


def warn_of_missing_labels(ignored: Sequence[str], names: list[str], ledger: Ledger) -> None:
    """Warn of ignored labels that no box has: a mistyped label would otherwise be mapped silently. names: the labels of all
    boxes."""
    missing = [label for label in dict.fromkeys(ignored) if label not in names]
    if missing:
        more = ", ..." * (len(names) > _SHOWN)
        ledger.warn(
            f"no box has the label {' or '.join(missing)} of rays.ignore_labels; labels of the log: "
            f"{', '.join(names[:_SHOWN]) or 'none'}{more}"
        )
