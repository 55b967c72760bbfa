"""What a session keeps of keyframes and rays."""

from __future__ import annotations

import numpy as np

from objslam.live.table import Table


def new_keyframes() -> Table:
    """No keyframes yet: columns as `types.Keyframes` has them; start_T_base is odom_T_base from where the odometry began."""
    pose = (np.float64, (4, 4))
    return Table(
        id=(np.int64, ()),
        stamp=(np.float64, ()),
        camera=(np.int64, ()),
        frame=(np.int64, ()),
        base_T_camera=pose,
        map_T_base=pose,
        start_T_base=pose,
        drift=(np.float64, (6, 6)),
        localized=(np.bool_, ()),
    )


def new_rays() -> Table:
    """No rays yet: columns as `types.Rays` has them, the number of each, owner (id of a landmark, -1 none), and whether the
    graph uses it."""
    return Table(
        number=(np.int64, ()),
        keyframe=(np.int64, ()),
        direction=(np.float64, (3,)),
        sigma=(np.float64, ()),
        range=(np.float64, ()),
        range_sigma=(np.float64, ()),
        label=(np.int64, ()),
        score=(np.float64, ()),
        box=(np.float64, (4,)),
        track=(np.int64, ()),
        owner=(np.int64, ()),
        used=(np.bool_, ()),
    )
