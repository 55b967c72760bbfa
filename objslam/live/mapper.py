"""The map of a session, message by message, in one thread: keyframes, association, graph.

What it does depends on the messages and their order alone, never on the time of day, so that a journal played again gives
the same map.
"""

from __future__ import annotations

import bisect

import numpy as np

from objslam.association.sightings import Sightings
from objslam.config import Settings
from objslam.geometry import adjoint, inverse, is_planar
from objslam.graph import factors
from objslam.graph.incremental import Bearings, IncrementalGraph
from objslam.live import known as landmarks
from objslam.live import upkeep
from objslam.live.candidates import Candidate, place, ripe
from objslam.live.counters import Counters
from objslam.live.matching import Doubt, FrameRays, best_of_label, in_map, match, match_by_label
from objslam.live.meeting import information, misses, sightings
from objslam.live.messages import CameraMessage, FrameMessage, Message, MountMessage, PoseMessage
from objslam.live.path import PathBuffer
from objslam.live.table import Table
from objslam.rays import box_rays
from objslam.types import Camera, Detections, Floats, Ints, Keyframes, label_table

_KEPT = 3.0  # s besides live.max_late that the path is kept for
_MOUNTS = 4096  # of one camera that are kept
_SETTLE = np.radians(2.0)  # rays that miss their landmarks by more are a loop that closes: the graph is given more time
_ASK = 10  # keyframes after which the graph is asked how well it knows where it is
_CANDIDATES = 150  # at the most
_TRACKS = 4096  # of the detector, that are remembered


class Mapper:
    """Takes messages in session time and keeps the map; not to be used from two threads at a time."""

    def __init__(self, settings: Settings, counters: Counters) -> None:
        self.settings, self.counters = settings, counters
        self.graph = IncrementalGraph(settings)
        self.cameras: list[Camera] = []
        self.labels: list[str] = []
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
        self.polished = self.frames = 0
        self.unsettled = False
        self.tracks: dict[int, int] = {}
        self._label_number: dict[str, int] = {}
        self._mounts: dict[str, tuple[list[float], list[Floats]]] = {}
        self._camera_number: dict[str, int] = {}
        self._frame_number: dict[int, int] = {}
        self._last: dict[int, Floats] = {}
        self._shown: set[int] = set()
        self._unlocalized: list[int] = []
        self._localizations = 0
        self._flat = True
        self._doubts: dict[int, Floats] = {}
        self._next_ray = self._next_keyframe = self._next_object = self._next_candidate = self._count = 0

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
                self._localizations += 1
                self.localization.append(message.stamp, message.pose)
                self._localize()
        elif isinstance(message, CameraMessage):
            number = self._camera_number.get(message.camera.name)
            if number is None:
                self._camera_number[message.camera.name] = len(self.cameras)
                self.cameras.append(message.camera)
            else:
                self.cameras[number] = message.camera
        elif isinstance(message, MountMessage):
            stamps, poses = self._mounts.setdefault(message.camera, ([], []))
            at = bisect.bisect_right(stamps, message.stamp)
            stamps.insert(at, message.stamp)
            poses.insert(at, message.pose)
            if len(stamps) > _MOUNTS:
                del stamps[0], poses[0]
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
        camera = self._camera_number[frame.camera]
        if found is None:
            self.leave_out(frame, "frames off the path, or in a gap of it")
            return False
        map_T_base, drift = found
        self.frames += 1
        start_T_base = self._lead().from_start(map_T_base)
        base_T_camera = self._mount(frame)
        number = self._frame_number.get(camera, 0)
        self._frame_number[camera] = number + 1
        rays = self._rays_of(frame, self.cameras[camera])
        moved = self._moved(camera, start_T_base @ base_T_camera)
        shown = set(rays.label.tolist())
        if moved:
            self._shown.clear()
        elif shown <= self._shown:
            self.counters.accept("frames between keyframes")
            return False
        if not len(rays) and not len(self.known):
            return False
        before = self._before(frame.stamp)
        if before is None and len(self.keyframes):
            self.leave_out(frame, "frames older than the map")
            return False
        k = self._next_keyframe
        row = {
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
        camera_from_drift = adjoint(inverse(start_T_base @ base_T_camera))
        guess, pose_doubt, motion = self._predict(before, row)
        doubt = Doubt(drift, camera_from_drift, pose_doubt)
        if not len(rays):  # what was not seen is evidence, but no keyframe
            self.known.expected[landmarks.in_view(self.known, self.cameras[camera], guess)] += 1
            return False
        self._next_keyframe += 1
        self._last[camera] = start_T_base @ base_T_camera
        self._shown |= shown
        self.keyframes.add(**{name: np.asarray(value)[None] for name, value in row.items()})
        self.graph.add_keyframe(k, guess)
        if motion is not None:
            assert before is not None
            self.graph.add_motion(int(self.keyframes.id[before]), k, *motion)
        elif before is None and not self._localized_only():
            self.graph.add_anchor(k, guess)
        self._unlocalized.append(k)
        self._localize()
        self._associate(rays, k, camera, guess, doubt, frame.stamp)
        return True

    def look_after(self) -> None:
        """What is due now and then, after a frame that became a keyframe."""
        upkeep.after_keyframe(self)

    def leave_out(self, frame: FrameMessage, reason: str) -> None:
        """Count a frame that is not to be looked at, and its boxes."""
        self.counters.drop(reason, f"camera {frame.camera}, stamp {frame.stamp:.3f}")
        self.counters.drop(reason.replace("frames", "boxes", 1), count=len(frame))

    def _associate(self, rays: FrameRays, k: int, camera: int, guess: Floats, doubt: Doubt, stamp: float) -> None:
        known, count = self.known, len(rays)
        settings = self.settings
        owner, used = np.full(count, -1, dtype=np.int64), np.zeros(count, dtype=bool)
        if self.by_label and settings.association.method == "auto" and len(set(rays.label.tolist())) < count:
            self.by_label = False  # two boxes of one label: labels do not tell objects apart
            self.candidates = [c for c in self.candidates if not c.by_label]
        numbers = self._next_ray + np.arange(count)
        self._next_ray += count
        mine = best_of_label(rays) if self.by_label else np.arange(count)
        some = take(rays, mine)
        if self.by_label:
            hit, missed = match_by_label(some, guess, known, doubt, settings.association.gate)
            lost = missed >= 0
            known.rejected[missed[lost]] += 1
            owner[mine[lost]] = known.id[missed[lost]]
            free = mine[(hit < 0) & ~lost]
        else:
            hit = match(some, guess, known, self.candidates, doubt, len(self.labels), settings.association.gate, self.tracks)
            for i in np.flatnonzero(hit >= len(known)).tolist():
                self._extend(self.candidates[hit[i] - len(known)], rays, i, numbers[i], k, stamp, doubt)
            free = mine[hit < 0]
            hit = np.where(hit < len(known), hit, -1)
        matched = mine[hit >= 0]
        rows = hit[hit >= 0]
        owner[matched], used[matched] = known.id[rows], True
        self.rays.add(
            number=numbers,
            keyframe=np.full(count, k),
            direction=rays.direction,
            sigma=rays.sigma,
            range=rays.range,
            range_sigma=rays.range_sigma,
            label=rays.label,
            score=rays.score,
            box=rays.box,
            track=rays.track,
            owner=owner,
            used=used,
        )
        for i in free.tolist():
            self._candidate(rays, i, numbers[i], k, stamp, doubt)
        place([c for c in self.candidates if not c.by_label and c.rays[-1][1] == k])
        if len(matched):
            self.graph.add_rays(self.bearings(len(self.rays) - count + matched))
        self._births(k)
        self.graph.update()
        self._seen(rays, matched, rows, k, camera, doubt, stamp)

    def _seen(self, rays: FrameRays, matched: Ints, rows: Ints, k: int, camera: int, doubt: Doubt, stamp: float) -> None:
        """What the landmarks of a frame learn from it."""
        known = self.known
        pose = self.graph.pose(k)
        seen = landmarks.in_view(known, self.cameras[camera], pose)
        seen[rows] = True
        known.expected[seen] += 1
        if not len(rows):
            return
        s = in_map(take(rays, matched), pose)
        known.position[rows] = self.graph.points(known.id[rows])
        off = misses(s, known.position[rows])
        self.unsettled |= bool((off * s.sigma).max() > _SETTLE)
        known.information[rows] += information(s, known.position[rows])
        known.squared[rows] += np.minimum(off, 6.0) ** 2
        known.seen[rows] += 1
        known.drift[rows] = doubt.drift
        known.last[rows] = np.maximum(known.last[rows], stamp)
        known.far[rows] = np.maximum(known.far[rows], np.linalg.norm(known.position[rows] - pose[:3, 3], axis=1))
        for i, row in zip(matched.tolist(), rows.tolist(), strict=True):
            if rays.track[i] >= 0:
                self.tracks[int(rays.track[i])] = int(known.id[row])
                if len(self.tracks) > _TRACKS:
                    del self.tracks[next(iter(self.tracks))]
        if not self.by_label and len(rows) > 1:
            ids = np.sort(known.id[rows])
            same = {int(j): int(label) for j, label in zip(known.id[rows], known.label[rows], strict=True)}
            for a in range(len(ids)):
                for b in range(a + 1, len(ids)):
                    pair = (int(ids[a]), int(ids[b]))
                    if same[pair[0]] == same[pair[1]]:
                        self.together[pair] = self.together.get(pair, 0) + 1

    def _births(self, k: int) -> None:
        """Candidates that saw something in this keyframe become landmarks where their rays carry it."""
        born: list[Candidate] = []
        for candidate in self.candidates:
            if candidate.rays[-1][1] != k:
                continue
            met = ripe(candidate, self.graph, self.settings, self.rng)
            if met is None:
                continue
            born.append(candidate)
            j = self._next_object
            self._next_object += 1
            numbers = candidate.numbers()
            at = np.searchsorted(self.rays.number, numbers)
            self.rays.owner[at] = j
            self.rays.used[at] = met.agree
            s = candidate.sight(self.graph)
            inner = s.take(met.agree)
            self.known.add(
                id=[j],
                position=met.position[None],
                information=information(inner, met.position).sum(axis=0)[None],
                label=[candidate.label],
                drift=candidate.drift[None],
                first=[candidate.first],
                last=[candidate.last],
                seen=[int(met.agree.sum())],
                expected=[len(candidate)],
                far=[float(np.linalg.norm(met.position - inner.origin, axis=1).max())],
                squared=[float((misses(inner, met.position) ** 2).clip(max=36.0).sum())],
                rejected=[0],
            )
            self.graph.add_landmark(j, met.position)
            self.graph.add_rays(self.bearings(at[met.agree]))
        for candidate in born:
            self.candidates.remove(candidate)

    def _candidate(self, rays: FrameRays, i: int, number: int, k: int, stamp: float, doubt: Doubt) -> None:
        label = int(rays.label[i])
        if self.by_label:
            for candidate in self.candidates:
                if candidate.label == label:
                    self._extend(candidate, rays, i, number, k, stamp, doubt)
                    return
        elif len(self.candidates) >= _CANDIDATES:
            self.candidates.remove(min(self.candidates, key=lambda c: (len(c) >= self.settings.live.min_rays, c.last)))
        candidate = Candidate(self._next_candidate, label, self.by_label, stamp, stamp, doubt.drift)
        self._next_candidate += 1
        self.candidates.append(candidate)
        self._extend(candidate, rays, i, number, k, stamp, doubt)

    def _extend(
        self, candidate: Candidate, rays: FrameRays, i: int, number: int, k: int, stamp: float, doubt: Doubt
    ) -> None:
        seen = (rays.direction[i], float(rays.sigma[i]), float(rays.range[i]), float(rays.range_sigma[i]))
        candidate.extend((int(number), k, *seen), self.graph.pose(k))
        candidate.last, candidate.drift = max(candidate.last, stamp), doubt.drift

    def bearings(self, at: Ints) -> Bearings:
        """Rows (n,) of the rays for the graph; ranges of one object share a bias, which no number of them takes away."""
        rays = self.rays
        share = np.zeros(len(at))
        ranged = np.isfinite(rays.range[at])
        if ranged.any():
            row = self.rows_of(rays.owner[at])
            share = np.where(ranged, self.known.seen[row] + 1, 0) * self.settings.depth.bias**2
        sigma = np.sqrt(np.where(ranged, rays.range_sigma[at], 1.0) ** 2 + share)
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
        for candidate in self.candidates:
            if candidate.last >= since:
                candidate.move(new_T_old)

    def rows_of(self, ids: Ints) -> Ints:
        """The rows of landmarks by their ids, which must be there."""
        return np.searchsorted(self.known.id, ids)

    def _predict(self, before: int | None, row: dict[str, object]) -> tuple[Floats, Floats, tuple[Floats, Floats] | None]:
        """The first guess (4, 4) of a keyframe's camera, the covariance (6, 6) of that, and its motion by odometry."""
        if before is None or self._localized_only():
            noise = self.settings.localization
            doubt = np.diag([noise.yaw] * 3 + [noise.xy] * 3) ** 2 if before is not None else np.zeros((6, 6))
            return np.asarray(row["map_T_base"]) @ np.asarray(row["base_T_camera"]), doubt, None
        motion, covariance = factors.motions(self._pair(before, row), self.settings)
        k = int(self.keyframes.id[before])
        back = adjoint(inverse(motion[0]))
        if k not in self._doubts:  # asked for now and then: between, the odometry adds to it
            self._doubts = {k: self.graph.pose_covariance(k)}
        doubt = back @ self._doubts[k] @ back.T + covariance[0]
        if self._next_keyframe % _ASK:
            self._doubts[self._next_keyframe] = doubt
        return self.graph.pose(k) @ motion[0], doubt, (motion[0], covariance[0])

    def _pair(self, before: int, row: dict[str, object]) -> Keyframes:
        def two(name: str) -> Floats:
            return np.stack([getattr(self.keyframes, name)[before], np.asarray(row[name])])

        return Keyframes(
            stamps=two("stamp"),
            camera=np.zeros(2, dtype=np.int64),
            frame=np.arange(2),
            base_T_camera=two("base_T_camera"),
            map_T_base=two("map_T_base"),
            odom_T_base=two("start_T_base"),
            drift=two("drift"),
        )

    def _localize(self) -> None:
        """Absolute poses for the keyframes that the localisation covers by now."""
        if not self._localizations or not self._unlocalized:
            return
        left = []
        for k in self._unlocalized:
            row = int(np.searchsorted(self.keyframes.id, k))
            if row == len(self.keyframes) or self.keyframes.id[row] != k:
                continue
            stamp = float(self.keyframes.stamp[row])
            if stamp > self.localization.newest:
                left.append(k)
                continue
            found = self.localization.at(stamp, self.settings.poses.max_gap)
            if found is None:
                continue
            self._flat = self._flat and is_planar(np.stack([np.eye(4), self.localization.from_start(found[0])]))
            first = not self.keyframes.localized.any() and not self._localized_only()
            if first:
                self._move_onto(row, found[0])
            self.keyframes.map_T_base[row] = found[0]
            self.keyframes.localized[row] = True
            one = self.keyframe_arrays(np.array([row]))
            self.graph.add_absolute(k, factors.localizations(one, self.settings, k, self._flat)[0])
            if first:
                self.graph.rebuild()
        self._unlocalized = left

    def _move_onto(self, row: int, map_T_base: Floats) -> None:
        """The first localisation says where the map is: so far it lay where the odometry began."""
        self.graph.update()
        there = map_T_base @ self.keyframes.base_T_camera[row] @ inverse(self.graph.pose(int(self.keyframes.id[row])))
        self.graph.drop_absolute()
        self.graph.move(there)
        self.known.position[:] = self.known.position @ there[:3, :3].T + there[:3, 3]
        spun = there[:3, :3]
        self.known.information[:] = spun @ self.known.information @ spun.T
        self.move_candidates(there, -np.inf)

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
            localized_every=max(1.0, self._next_keyframe / max(self._localizations, 1)) if localized else 0.0,
            odom_T_base=None if self._localized_only() else k.start_T_base[rows],
            drift=None if self._localized_only() else k.drift[rows],
        )

    def _lead(self) -> PathBuffer:
        return self.localization if self._localized_only() else self.odometry

    def _localized_only(self) -> bool:
        return self.odometry.newest == -np.inf

    def _before(self, stamp: float) -> int | None:
        """The row of the newest keyframe that is not newer than a stamp."""
        stamps = self.keyframes.stamp
        if len(stamps) and stamps[-1] <= stamp:
            return len(stamps) - 1
        older = np.flatnonzero(stamps <= stamp)
        return int(older[stamps[older].argmax()]) if len(older) else None

    def _moved(self, camera: int, start_T_camera: Floats) -> bool:
        last = self._last.get(camera)
        if last is None:
            return True
        live = self.settings.live
        step = inverse(last) @ start_T_camera
        turned = np.arccos(np.clip((np.trace(step[:3, :3]) - 1) / 2, -1.0, 1.0))
        return bool(np.linalg.norm(step[:3, 3]) >= live.keyframe_distance or turned >= np.radians(live.keyframe_angle_deg))

    def _mount(self, frame: FrameMessage) -> Floats:
        stamps, poses = self._mounts.get(frame.camera, ([], []))
        at = bisect.bisect_right(stamps, frame.stamp)
        return poses[at - 1] if at else self.cameras[self._camera_number[frame.camera]].base_T_camera

    def _rays_of(self, frame: FrameMessage, camera: Camera) -> FrameRays:
        names, label = label_table(frame.labels)
        boxes = Detections(
            frame_stamps=np.array([frame.stamp]),
            frame=np.zeros(len(frame), dtype=np.int64),
            boxes=frame.boxes,
            label=label,
            scores=frame.scores,
            depths=frame.depths,
            track_ids=frame.track_ids,
            label_names=names,
        )
        boxes, direction, sigma = box_rays(boxes, camera, self.settings, self.counters.ledger)
        for name in names:
            if name not in self._label_number:
                self._label_number[name] = len(self.labels)
                self.labels.append(name)
        number = np.array([self._label_number[name] for name in names], dtype=np.int64)
        depth = boxes.depths if self.settings.depth.use else np.full(len(boxes), np.nan)
        reach = depth / direction[:, 2]
        return FrameRays(
            direction=direction,
            sigma=sigma,
            range=reach,
            range_sigma=self.settings.depth.sigma + self.settings.depth.sigma_per_m * reach,
            label=number[boxes.label] if len(boxes) else boxes.label,
            score=boxes.scores,
            box=boxes.boxes,
            track=boxes.track_ids,
        )


def take(rays: FrameRays, which: Ints) -> FrameRays:
    """Some of the rays of a frame (n,)."""
    return FrameRays(**{name: value[which] for name, value in vars(rays).items()})


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
