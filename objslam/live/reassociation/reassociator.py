"""Associates the whole drive of a running session again, in rounds.

A session decides for each frame which box belongs to which object. Some decisions turn out to be wrong later. A thing that
comes back into view after a long drive is a new object, until the path is known well enough. A robot that turns sees a thing
for a second, and sees it again minutes later from another place. Neither view alone gives a position, and the tracks of the
two views do not meet until the path is right. The offline association corrects all these errors, because it solves the whole
drive.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from objslam.association.duplicates import may_be_one
from objslam.config import Settings
from objslam.core.arrays import Bools, Ints
from objslam.core.camera import Camera
from objslam.core.diagnostics import Ledger
from objslam.core.types import Rays
from objslam.core.validity import rigid_poses
from objslam.graph.maps.live_prior_map import map_T_graph
from objslam.live.calibration.collected import Collected, collect
from objslam.live.counters import Counters
from objslam.live.mapper.data_association import first_boxes
from objslam.live.mapper.mapper import Mapper
from objslam.live.reassociation.adoption import adopt, plan_of
from objslam.live.rounds import Rounds
from objslam.sources.journal.corrections import AssociationMessage

_GROWTH = 1.3
"""The factor by which the number of keyframes grows between the starts of two rounds. A larger factor takes less time, but
things that come back into view stay new objects for longer."""
_DELAY = 0.1
"""The share by which the number of keyframes grows between the start of a round and the correction of the map. A larger
share suits slower machines, but corrects the map later."""
_KNOWN = 0.5
"""An object is already in the map if at least this share of its rays belong to landmarks of the session. Any other object
enters the map only if its position is reliable. A larger share keeps more objects out."""
_RIGHT = 0.5
"""The least share of the rays of all landmarks that an association must give to objects to take effect. With a smaller
share, a wrong solve may spoil the map. With a larger share, walking people stay landmarks in places with many people. Four
simulated sessions among eight people ended with 23 false objects at 0.7, and with 15 at 0.5."""


@dataclass(frozen=True)
class AssociationRequest:
    """The drive of a session so far.

    owner: (R,) the session's landmark of each ray, -1 for a ray without a landmark. classes: (R,) whether the label of a ray
    may have several objects. The rays of other labels stay with their landmarks.
    """

    found: Collected
    owner: Ints
    classes: Bools
    cameras: tuple[Camera, ...]
    settings: Settings

    def solve(self) -> AssociationMessage | None:
        """Associate and solve the drive as at the end of the session.

        The keyframe of the message is 0, and the caller must set it. An object that the session does not know is left out if
        its parallax is small, because later views would not fit its first position. Return None if the solve explains too
        few rays, or if poses are too far away. Raises SolveError if the solve fails.
        """
        from objslam.graph.init_unknown_correspondences import InitialEstimate
        from objslam.mapping.alternation import solve
        from objslam.mapping.corrected import corrected
        from objslam.mapping.describe import describe

        f, ledger = self.found, Ledger()
        start = InitialEstimate(f.map_T_camera, f.association, f.positions)
        solution = solve(f.keyframes, f.rays, self.cameras, self.settings, ledger, lambda *_: None, start, f.errors)
        if solution.errors is not None:
            solution, _ = corrected(solution, solution.errors, ledger)
        used = solution.estimate.weight > 0
        held = self.owner >= 0
        if held.any() and (used & (solution.association.object >= 0))[held].mean() < _RIGHT:
            return None
        objects, _ = describe(solution, self.cameras, self.settings)
        judged = self.classes & _are_first(f.rays)
        rays, places, free = [], [], judged.copy()
        for j, one in enumerate(objects.objects):
            mine = used & (solution.association.object == j) & judged
            ranged = bool(np.isfinite(f.rays.range[mine]).any())
            placed = one.status == "ok" and (ranged or one.parallax_deg >= self.settings.joint.min_parallax_deg)
            if mine.any() and (placed or held[mine].mean() >= _KNOWN):
                rays.append(np.sort(f.numbers[mine]))
                places.append(solution.estimate.positions[j])
                free &= ~mine
        poses, valid = rigid_poses(solution.estimate.map_T_base @ solution.keyframes.base_T_camera)
        if not valid.all():
            return None
        positions, order = np.array(places).reshape(-1, 3), np.argsort(f.keyframe_ids)
        return AssociationMessage(0, tuple(rays), positions, np.sort(f.numbers[free]), f.keyframe_ids[order], poses[order])


def _are_first(rays: Rays) -> Bools:
    """Return which rays (R,) are of boxes that a session gives to landmarks (`first_boxes`)."""
    first = np.zeros(len(rays), dtype=bool)
    for mine in np.split(np.arange(len(rays)), np.flatnonzero(np.diff(rays.keyframe)) + 1):
        first[mine[first_boxes(rays.score[mine], may_be_one(rays.box[mine], rays.label[mine]))]] = True
    return first


class Reassociator(Rounds[AssociationMessage | None, AssociationMessage]):
    """Associates the drive so far in rounds, and corrects the map."""

    growth, delay, quick, told = _GROWTH, _DELAY, False, AssociationMessage

    def __init__(
        self,
        settings: Settings,
        counters: Counters,
        mapper: Mapper,
        record: Callable[[AssociationMessage], bool],
        name: str,
        patient: bool,
    ) -> None:
        """Prepare for a session. name: the name of the log. The other arguments are as in `Rounds`."""
        super().__init__(mapper, record, settings.live.search_from, patient)
        self._counters, self._name = counters, name

    def _request(self) -> AssociationRequest | None:
        """Return the drive so far. Return None if no label has several objects, if the map has no landmarks, if the session
        has too many boxes, or if the map is tied to a prior map. The association does not know the objects of a prior
        map."""
        m = self._mapper.state
        if map_T_graph(m.graph) is not None:
            return None
        classes = m.kinds.classes(m.rays.label)
        if not classes.any() or not len(m.landmarks) or len(classes) > m.settings.live.reassociate:
            return None
        found = collect(m, self._name, running=True)
        at = np.searchsorted(m.rays.number, found.numbers)
        return AssociationRequest(
            found, m.rays.owner[at], classes[at], tuple(one.camera for one in found.log.cameras), m.given
        )

    def _correction(self, number: int, answer: AssociationMessage | None) -> AssociationMessage | None:
        """Return the association if it adds, removes or merges landmarks. Else return None."""
        if answer is None or map_T_graph(self._mapper.state.graph) is not None:
            self._counters.accept("associations given up")
            return None
        plan = plan_of(self._mapper.state, answer)
        if not plan.new.any() and not len(plan.gone):
            self._counters.accept("associations without a change")
            return None
        return replace(answer, keyframe=number)

    def _take_up(self, correction: AssociationMessage) -> None:
        merged, gone, added = adopt(self._mapper.state, correction)
        for kind, count in (
            ("merged objects", merged),
            ("landmarks that are no objects", gone),
            ("objects found in earlier boxes", added),
        ):
            if count:
                self._counters.accept(kind, count)
