"""The map of a session, message by message, in one thread: keyframes, association, graph.

What it does depends on the messages and their order alone, never on the time of day, so that a journal played again gives
the same map.
"""

from __future__ import annotations

import bisect
from typing import Any

import numpy as np

from objslam.association.sightings import Sightings
from objslam.config import Settings
from objslam.geometry import adjoint, inverse
from objslam.graph import factors
from objslam.graph.incremental import IncrementalGraph
from objslam.graph.kept import Bearings
from objslam.live import known as landmarks
from objslam.live import upkeep
from objslam.live.associating import associate
from objslam.live.births import give_birth, leave_out_the_least
from objslam.live.candidates import Candidate, place
from objslam.live.columns import new_keyframes, new_rays
from objslam.live.counters import Counters
from objslam.live.expected import Expected, expect
from objslam.live.frame_reader import FrameReader
from objslam.live.learning import Lesson, learn
from objslam.live.localizing import localize
from objslam.live.matching import Doubt
from objslam.live.meeting import sightings
from objslam.live.messages import CameraMessage, FrameMessage, Message, MountMessage, PoseMessage
from objslam.live.pace import Pace
from objslam.live.path import PathBuffer
from objslam.types import Camera, Floats, Ints, Keyframes

_KEPT = 3.0  # s besides live.max_late that the path is kept for
_ASK = 10  # keyframes after which the graph is asked how well it knows where it is


class Mapper:
    """Takes messages in session time and keeps the map; not to be used from two threads at a time."""

    def __init__(self, settings: Settings, counters: Counters) -> None:
        self.settings, self.counters = settings, counters
        self.graph = IncrementalGraph(settings)
        self.reader = FrameReader(settings, counters.ledger)
        self.keyframes = new_keyframes()
        self.rays = new_rays()
        self.known = landmarks.new_landmarks()
        self.candidates: list[Candidate] = []
        self.by_label = settings.association.method != "global"
        self.together: dict[tuple[int, int], int] = {}
        self.apart: dict[tuple[int, int], int] = {}
        self.looked_at: object = None
        self.rng = np.random.default_rng(settings.seed)
        self.waiting: list[tuple[float, int, FrameMessage, float]] = []
        seconds = settings.live.max_late + _KEPT
        self.odometry = PathBuffer(settings.odometry, seconds)
        self.localization = PathBuffer(settings.odometry, seconds)
        self.polished = self.thinned = self.frames = 0
        self.unsettled, self.unrest = False, 0
        self.tracks: dict[int, int] = {}
        self._frame_number: dict[int, int] = {}
        self.pace = Pace(settings.live)
        self.unlocalized: list[int] = []
        self.localizations = 0
        self.flat = True
        self._doubts: dict[int, Floats] = {}
        self._last_floor: tuple[Floats | None, bool, Floats] = (None, True, np.zeros((6, 6)))
        self.lesson: Lesson | None = None
        self.grown: list[Candidate] = []
        self.expected: Expected | None = None
        self.doubt = np.full((6, 6), np.nan)
        self.novelty = 1.0
        self.next_ray = self._next_keyframe = self._count = 0
        self.next_object = self.next_candidate = 0

    @property
    def cameras(self) -> list[Camera]:
        """The cameras, in the order in which they came."""
        return self.reader.cameras

    @property
    def labels(self) -> list[str]:
        """The labels by their numbers."""
        return self.reader.labels

    @property
    def keyframes_so_far(self) -> int:
        """How many keyframes there were, those left out since then included."""
        return self._next_keyframe

    def feed(self, message: Message, arrival: float) -> None:
        """Take one message; frames that the path now covers are ready."""
        if isinstance(message, PoseMessage):
            if message.path == "odometry":
                self.odometry.append(message.stamp, message.pose)
            else:
                self.localizations += 1
                self.localization.append(message.stamp, message.pose)
                localize(self)
        elif isinstance(message, CameraMessage):
            self.reader.add_camera(message.camera)
        elif isinstance(message, MountMessage):
            self.reader.add_mount(message)
        elif isinstance(message, FrameMessage):
            self._count += 1
            bisect.insort(self.waiting, (message.stamp, self._count, message, arrival))
            while len(self.waiting) > self.settings.live.max_frames_waiting:
                self.leave_out(self.waiting.pop(0)[2], "frames that waited for the path in vain")

    def ready(self) -> tuple[FrameMessage, float] | None:
        """The next frame whose place on the path is known, and when it arrived."""
        lead = self._lead()
        if not self.waiting or lead.newest < self.waiting[0][0]:
            return None
        _, _, frame, arrival = self.waiting.pop(0)
        return frame, arrival

    def take(self, frame: FrameMessage) -> bool:
        """Work a frame into the map; whether it became a keyframe."""
        max_gap = self.settings.poses.max_gap
        found = self._lead().at(frame.stamp, max_gap)
        camera = self.reader.number[frame.camera]
        if found is None:
            self.leave_out(frame, "frames off the path, or in a gap of it")
            return False
        map_T_base, drift = found
        self.frames += 1
        start_T_base = self._lead().from_start(map_T_base)
        base_T_camera = self.reader.mount(frame)
        number = self._frame_number.get(camera, 0)
        self._frame_number[camera] = number + 1
        rays = self.reader.rays(frame)
        start_T_camera = start_T_base @ base_T_camera
        shown = set(rays.label.tolist())
        if self.pace.skips(camera, start_T_camera, shown):
            self.counters.accept("frames between keyframes")
            return False
        if not len(rays) and not len(self.known):
            return False
        before = self._before(frame.stamp)
        if before is None and len(self.keyframes):
            self.leave_out(frame, "frames older than the map")
            return False
        k = self._next_keyframe
        row: dict[str, Any] = {
            "id": k,
            "stamp": frame.stamp,
            "camera": camera,
            "frame": number,
            "base_T_camera": base_T_camera,
            "map_T_base": map_T_base,
            "start_T_base": start_T_base,
            "drift": drift,
            "localized": False,
        }
        camera_from_drift = adjoint(inverse(start_T_camera))
        guess, pose_doubt, motion = self._predict(before, row, start_T_camera, camera_from_drift)
        doubt = Doubt(drift, camera_from_drift, pose_doubt)
        if not len(rays):  # what was not seen is evidence, but no keyframe
            self.known.expected[landmarks.in_view(self.known, self.cameras[camera], guess)] += 1
            return False
        self._next_keyframe += 1
        self.pace.keeps(camera, start_T_camera, shown)
        self.keyframes.add(**{name: np.asarray(value)[None] for name, value in row.items()})
        self.graph.add_keyframe(k, guess)
        if motion is not None:
            assert before is not None
            self.graph.add_motion(int(self.keyframes.id[before]), k, *motion)
        elif before is None and not self.localized_only:
            self.graph.add_anchor(k, guess)
        self.unlocalized.append(k)
        localize(self)
        associate(self, rays, k, camera, guess, doubt, frame.stamp)
        return True

    def look_after(self) -> None:
        """After a frame that became a keyframe: what its landmarks learn from it, and what is due now and then."""
        if self.lesson is not None:
            learn(self, self.lesson)
            place([c for c in give_birth(self, self.grown) if not c.by_label])
            self.lesson, self.grown = None, []
        upkeep.after_keyframe(self)
        if not self.by_label:
            leave_out_the_least(self)
            self.expected = expect(self.known, self.candidates)
        if not self.localized_only:  # the next frame asks that, and need not wait for it
            self._ask_doubt(int(self.keyframes.id[-1]))

    def leave_out(self, frame: FrameMessage, reason: str) -> None:
        """Count a frame that is not to be looked at, and its boxes."""
        self.counters.drop(reason, f"camera {frame.camera}, stamp {frame.stamp:.3f}")
        self.counters.drop(reason.replace("frames", "boxes", 1), count=len(frame))

    def bearings(self, at: Ints) -> Bearings:
        """Rows (n,) of the rays for the graph; ranges of one object share a bias, which no number of them takes away."""
        rays = self.rays
        sigma = rays.range_sigma[at]
        if np.isfinite(sigma).any():
            row = self.rows_of(rays.owner[at])
            sigma = np.sqrt(sigma**2 + (self.known.seen[row] + 1) * self.settings.depth.bias**2)
        return Bearings(
            number=rays.number[at],
            keyframe=rays.keyframe[at],
            landmark=rays.owner[at],
            direction=rays.direction[at],
            sigma=rays.sigma[at],
            range=rays.range[at],
            range_sigma=sigma,
        )

    def sight(self, at: Ints) -> Sightings:
        """Rows (n,) of the rays in map, as of the graph's last refresh."""
        rays = self.rays
        ids, index = np.unique(rays.keyframe[at], return_inverse=True)
        poses = self.graph.poses(ids)[index]
        ahead = np.einsum("rij,rj->ri", poses[:, :3, :3], rays.direction[at])
        return sightings(poses[:, :3, 3], ahead, rays.sigma[at], rays.range[at], rays.range_sigma[at])

    def move_candidates(self, new_T_old: Floats, since: float) -> None:
        """Candidates seen from a stamp on moved by a pose (4, 4), as the path was."""
        self.expected = None
        for candidate in self.candidates:
            if candidate.last >= since:
                candidate.move(new_T_old)

    def rows_of(self, ids: Ints) -> Ints:
        """The rows of landmarks by their ids, which must be there."""
        return np.searchsorted(self.known.id, ids)

    def in_order(self) -> Ints:
        """The keyframes (K,) by their stamps."""
        return np.asarray(self.keyframes.id[np.argsort(self.keyframes.stamp, kind="stable")])

    def _predict(
        self, before: int | None, row: dict[str, Any], start_T_camera: Floats, camera_from_drift: Floats
    ) -> tuple[Floats, Floats, tuple[Floats, Floats] | None]:
        """The first guess (4, 4) of a keyframe's camera, the covariance (6, 6) of that, and its motion by odometry."""
        if before is None or self.localized_only:
            noise = self.settings.localization
            doubt = np.diag([noise.yaw] * 3 + [noise.xy] * 3) ** 2 if before is not None else np.zeros((6, 6))
            return row["map_T_base"] @ row["base_T_camera"], doubt, None
        of = self.keyframes
        k = int(of.id[before])
        motion = inverse(of.start_T_base[before] @ of.base_T_camera[before]) @ start_T_camera
        floor = self._floor(row["base_T_camera"])
        covariance = factors.motion_covariance(row["drift"] - of.drift[before], camera_from_drift, floor)
        self._ask_doubt(k)
        back = adjoint(inverse(motion))
        self.doubt = back @ self._doubts[k] @ back.T + covariance
        if self._next_keyframe % _ASK:
            self._doubts[self._next_keyframe] = self.doubt
        return self.graph.pose(k) @ motion, self.doubt, (motion, covariance)

    def _ask_doubt(self, k: int) -> None:
        """How well the graph knows keyframe k; asked for now and then: between, the odometry adds to it."""
        if k not in self._doubts:
            self._doubts = {k: self.graph.pose_covariance(k)}

    def _floor(self, base_T_camera: Floats) -> Floats:
        """`factors.motion_floor`, which is the same as long as the mount and the plane are."""
        made_for, planar, floor = self._last_floor
        if made_for is not base_T_camera or planar != self.odometry.planar:
            floor = factors.motion_floor(base_T_camera, self.settings, self.odometry.planar)
            self._last_floor = base_T_camera, self.odometry.planar, floor
        return floor

    def keyframe_arrays(self, rows: Ints) -> Keyframes:
        """Some of the keyframes (n,), as offline has them."""
        k = self.keyframes
        localized = bool(k.localized.any())
        return Keyframes(
            stamps=k.stamp[rows],
            camera=k.camera[rows],
            frame=k.frame[rows],
            base_T_camera=k.base_T_camera[rows],
            map_T_base=k.map_T_base[rows],
            localized_every=max(1.0, self._next_keyframe / max(self.localizations, 1)) if localized else 0.0,
            odom_T_base=None if self.localized_only else k.start_T_base[rows],
            drift=None if self.localized_only else k.drift[rows],
        )

    def _lead(self) -> PathBuffer:
        return self.localization if self.localized_only else self.odometry

    @property
    def localized_only(self) -> bool:
        """Whether there has been no odometry."""
        return self.odometry.newest == -np.inf

    def _before(self, stamp: float) -> int | None:
        """The row of the newest keyframe that is not newer than a stamp."""
        stamps = self.keyframes.stamp
        if len(stamps) and stamps[-1] <= stamp:
            return len(stamps) - 1
        older = np.flatnonzero(stamps <= stamp)
        return int(older[stamps[older].argmax()]) if len(older) else None
