"""What a map at the given poses tells a joint solve of the same log."""

from dataclasses import dataclass

import numpy as np

from objslam.core.types import Association, Rays
from objslam.mapping.fixed.lasting_noise import LastingNoise


@dataclass(frozen=True)
class MapAtPoses:
    """A map at the given poses. lasting: the errors that the given poses have for seconds, None if they are too small for a
    finding. rays: the rays of the map. association: the association of the rays. trusted: whether no wrong input spoils the
    map."""

    lasting: LastingNoise | None
    rays: Rays
    association: Association
    trusted: bool

    def association_of(self, rays: Rays) -> Association | None:
        """Return the association if the map is trusted and the given rays are from the same boxes as its rays. Otherwise
        return None. The directions of the rays may differ."""
        ours, theirs = (np.column_stack([of.keyframe, of.label, of.box]) for of in (self.rays, rays))
        same = np.array_equal(ours, theirs, equal_nan=True)  # Bearings without a box have NaN.
        same = self.trusted and same and self.rays.label_names == rays.label_names
        return self.association if same else None
