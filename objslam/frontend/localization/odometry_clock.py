"""Find the offset between the clocks of odometry and localisation from the two paths alone.

A localisation is often late by its computing time. An odometry from commanded velocities is early, because wheels follow a
command late. So the two can be some tenths of a second apart. In a turn, a robot then seems to have two headings. At the
right offset, both paths turn, start and stop at the same times.
"""

from dataclasses import dataclass, replace
from typing import Self

import numpy as np

from objslam.config import Settings
from objslam.core.arrays import Floats
from objslam.core.diagnostics import Ledger
from objslam.core.geometry import interpolate, inverse, lengths, log_se3
from objslam.core.rotation import rotation_vector
from objslam.core.statistics import HUBER_K, NORMAL_MEDIAN
from objslam.core.trajectory import Trajectory
from objslam.core.types import Log
from objslam.frontend.localization.localization_jumps import STILL, steps_of

_TRIED = 0.04
"""The distance (s) between the offsets that are tried first. Turns of robots last longer than this, so the fit converges
from the best tried offset. A larger distance is faster and may miss the best offset."""
_SPAN = 1.0
"""The least time (s) over which the two paths are compared. Over a shorter time, the noise of single poses hides a turn.
Over a longer time, the drift of the odometry hides it. Turns of recorded robots last 1 to 4 s."""
_LONGEST = 10.0
"""The longest time (s) over which the paths are compared. Rare localisations have a pose each 2 to 10 s. A larger value
compares paths between which the odometry has drifted more."""
_MOST = 6000
"""The most spans that are compared, spread over the log. A larger number is slower."""
_BLOCK = 5.0
"""The time (s) over which errors of the paths may be alike. The standard deviation comes from sums over such blocks. A
larger value leaves fewer blocks, so it needs longer logs."""
_FEWEST_BLOCKS = 5
"""The fewest blocks in which the robot must turn, start or stop. Fewer blocks do not show the standard deviation. A larger
number leaves more short logs as they are."""
_MOVING = 0.02
"""The least motion (m or rad) of the robot in a span that shows the noise of the paths. A robot at rest has less noise. A
larger value takes the noise from fewer spans."""
_FINEST = 1e-3
"""The least noise (m or rad) that two paths are taken to have. Without this limit, two exact copies of a path would have no
noise, and the fit would have no result. A larger value gives exact paths less weight."""
_UNEVEN = 0.003
"""The standard deviation (s) that is added to that of every offset. The motion between two poses is taken to be even, but is
not quite even. In simulated drives with a pose each 2 s, this error was 3 to 6 ms. A larger value makes the standard
deviation larger."""
_ROUNDS = 8
"""The most steps of the fit from the best offset that was tried. It usually needs four. A larger number is slower."""
_LOOSE = np.array([1.0, 0.3, 0.3, 0.1, 0.1, 0.1])
"""The prior standard deviations of the offset (s), of the scales of turns and moves, and of the rates of turns (rad/s). They
only keep the fit regular if a robot never moves. Larger values hold the fit less."""
_DELTA = 0.005
"""Half the time (s) over which the rate of a path is taken. A larger value blurs the rate, and a smaller one meets
rounding."""
_REPEATED = 0.01
"""The largest median difference between steps of a localisation and of the odometry, as a share of the step, at which the
localisation repeats the odometry. Rounding in a file makes a share of 1e-3, and an offset of 0.03 s in a turn makes 0.1. A
larger value takes more localisations for copies."""
_HARMFUL = 0.03
"""The least offset (s) that is corrected. At 0.6 rad/s it turns the robot by 1 deg, which is as much as the noise of a
localisation. Cameras have the same accuracy from their own clocks. A larger value leaves larger errors. A smaller value
changes logs in which nothing is wrong."""
_CLEAR = 5.0
"""The least offset that is corrected, in its standard deviations. In simulated logs without an offset, offsets of up to 3
standard deviations were found. A larger number corrects fewer logs."""
_GAIN = 10.0
"""The least gain in log likelihood of an offset that is corrected. The likelihood is that of Laplace's distribution with
unknown width. Each span of time that overlaps no other counts as one measurement. A larger number corrects fewer logs."""


@dataclass(frozen=True)
class OdometryClock:
    """The clock of an odometry. offset: s, to be added to the stamps of the odometry. It is positive if these stamps are
    early. sigma: s, the standard deviation of the offset."""

    offset: float
    sigma: float

    def to_dict(self) -> dict[str, float]:
        """Return the offset and its standard deviation for summary.json."""
        return {"offset": round(self.offset, 4), "sigma": round(self.sigma, 4)}


def at_one_clock(log: Log, settings: Settings, ledger: Ledger) -> tuple[Log, OdometryClock | None]:
    """Return the log with the stamps of its odometry in the clock of its localisation, and the corrected clock.

    The localisation keeps its stamps, because the clocks of cameras are estimated against it. If the offset is not clearly
    harmful, or the settings keep the stamps, the log is returned unchanged, with None. If the stamps are corrected, the
    ledger gets a warning.
    """
    found = _found(log, settings)
    if found is None or log.odometry is None:
        return log, None
    ledger.warn(f"{_said(found)}: corrected (--set calibration.odometry_clock=false keeps them)")
    return replace(log, odometry=replace(log.odometry, stamps=log.odometry.stamps + found.offset)), found


def warn_of_two_clocks(log: Log, settings: Settings, ledger: Ledger) -> None:
    """Warn if a run with `at_one_clock` would correct the stamps of the odometry, but this session does not."""
    found = _found(log, settings)
    if found is not None:
        ledger.warn(f"{_said(found)}: a session keeps them, and objslam run on its journal corrects them")


def _found(log: Log, settings: Settings) -> OdometryClock | None:
    if log.odometry is None or log.localization is None or not settings.calibration.corrects_odometry_clock:
        return None
    return clock_of_odometry(log.odometry, log.localization, settings.calibration.max_clock, settings.poses.max_gap)


def _said(found: OdometryClock) -> str:
    late = "early" if found.offset > 0 else "late"
    return (
        f"the odometry's stamps are {abs(found.offset):.2f} s {late} against those of the localisation "
        f"(+- {max(found.sigma, 0.005):.2f} s)"
    )


def clock_of_odometry(
    odometry: Trajectory, localization: Trajectory, longest: float, max_gap: float
) -> OdometryClock | None:
    """Return the clock of an odometry, None if it is not clearly wrong.

    longest: s, the largest offset that is considered. max_gap: s, the longest gap between two poses of the odometry that is
    bridged.
    """
    if len(odometry) < 3 or len(localization) < 3:
        return None
    if _repeats(odometry, localization, max_gap):
        return None
    spans = _Spans.of(odometry, localization, longest, max_gap)
    if len(spans.begin) < _FEWEST_BLOCKS:
        return None
    offsets = np.arange(-longest, longest + _TRIED / 2, _TRIED)
    tried = [sum(_width(missed) for missed in spans.missed(offset)) for offset in offsets.tolist()]
    best = int(np.argmin(tried))
    if best in (0, len(offsets) - 1):  # The right offset may lie beyond.
        return None
    found = spans.fitted(float(offsets[best]), free=True)
    without = spans.fitted(0.0, free=False)
    if found is None or without is None or abs(found.offset) > longest:
        return None
    gain = without.cost - found.cost
    clear = abs(found.offset) >= max(_HARMFUL, _CLEAR * found.sigma) and gain >= _GAIN
    return OdometryClock(found.offset, found.sigma) if clear else None


@dataclass(frozen=True)
class _Way:
    """How far a path has turned and moved since its start, in the frame of base. So the map frames of two paths need not
    agree.

    stamps: (N,) s. felt: (N, 6) the sums of the turns, rad, and of the moves, m, in base. area: (N, 6) the integral of
    `felt` over the time. width: s, over which `felt` is averaged. An interpolated pose between two measured poses has less
    noise than a measured one. So without the average, an offset of half a step would fit better.
    """

    stamps: Floats
    felt: Floats
    area: Floats
    width: float

    @classmethod
    def of(cls, path: Trajectory, begin: float) -> Self:
        """Return the way of a path, with stamps since `begin`, s."""
        step = inverse(path.poses[:-1]) @ path.poses[1:]
        moved = np.concatenate([rotation_vector(step[:, :3, :3]), step[:, :3, 3]], axis=1)
        felt = np.concatenate([np.zeros((1, 6)), np.cumsum(moved, axis=0)])
        stamps = path.stamps - begin
        seconds = np.diff(stamps)
        area = np.concatenate([np.zeros((1, 6)), np.cumsum((felt[1:] + felt[:-1]) / 2 * seconds[:, None], axis=0)])
        return cls(stamps, felt, area, 2 * float(np.median(seconds)))

    def at(self, stamps: Floats) -> Floats:
        """Return the mean of `felt` (n, 6) around stamps (n,), s."""
        return np.asarray((self._area(stamps + self.width / 2) - self._area(stamps - self.width / 2)) / self.width)

    def _area(self, stamps: Floats) -> Floats:
        before = np.clip(np.searchsorted(self.stamps, stamps, side="right") - 1, 0, len(self.stamps) - 2)
        since, step = stamps - self.stamps[before], self.stamps[before + 1] - self.stamps[before]
        slope = (self.felt[before + 1] - self.felt[before]) / step[:, None]
        return np.asarray(self.area[before] + since[:, None] * (self.felt[before] + slope * since[:, None] / 2))


@dataclass(frozen=True)
class _Fit:
    """The fit of a clock. offset, sigma: s, the offset and its standard deviation. cost: the negative log likelihood by
    Laplace's distribution."""

    offset: float
    sigma: float
    cost: float


@dataclass(frozen=True)
class _Spans:
    """Spans of time over which a localisation and an odometry are compared.

    begin, end: (n,) s. told: (n, 6) the turn and the move of the localisation in each span, as in `_Way.felt`. odometry: the
    way of the odometry. kinds: the columns that are compared, turns and moves.
    """

    begin: Floats
    end: Floats
    told: Floats
    odometry: _Way
    kinds: tuple[slice, ...]

    @classmethod
    def of(cls, odometry: Trajectory, localization: Trajectory, longest: float, max_gap: float) -> Self:
        """Return the spans between poses of a localisation around which the odometry has no gap."""
        way = _Way.of(odometry, float(odometry.stamps[0]))
        poses, stamps = localization.poses, localization.stamps - odometry.stamps[0]
        # A pose that is repeated until the next one is known would make the localisation late.
        new = np.append(True, lengths(steps_of(poses)).max(axis=1) > STILL)
        poses, stamps = poses[new], stamps[new]
        if len(stamps) < 2:
            return cls(np.zeros(0), np.zeros(0), np.zeros((0, 6)), way, ())
        felt = _Way.of(Trajectory(stamps, poses), 0.0).felt
        begin = np.arange(len(stamps))
        end = np.searchsorted(stamps, stamps + (_SPAN - 1e-6))
        begin, end = begin[end < len(stamps)], end[end < len(stamps)]
        reach = longest + way.width + _DELTA
        first, last = stamps[begin] - reach, stamps[end] + reach
        good = (first >= way.stamps[0]) & (last <= way.stamps[-1]) & (stamps[end] - stamps[begin] <= _LONGEST)
        gaps = np.flatnonzero(np.diff(way.stamps) > max_gap)
        good &= np.searchsorted(way.stamps[gaps + 1], first) == np.searchsorted(way.stamps[gaps], last)
        begin, end = begin[good], end[good]
        if len(begin) > _MOST:
            kept = np.linspace(0, len(begin) - 1, _MOST).astype(np.int64)
            begin, end = begin[kept], end[kept]
        # Between rare poses a robot drives curves, and the sum of its moves in base is not known.
        fine = len(begin) and np.median(np.diff(stamps)) <= _SPAN / 4
        kinds = (slice(0, 3), slice(3, 6)) if fine else (slice(0, 3),)
        return cls(stamps[begin], stamps[end], felt[end] - felt[begin], way, kinds)

    def by_odometry(self, offset: float) -> Floats:
        """Return the turn and the move (n, 6) of the odometry in each span, if `offset`, s, is added to its stamps."""
        return self.odometry.at(self.end - offset) - self.odometry.at(self.begin - offset)

    def missed(self, offset: float) -> list[Floats]:
        """Return for each kind how far (n,) the two paths differ at an offset, s."""
        off = _unwrapped(self.told - self.by_odometry(offset))
        return [lengths(off[:, kind]) for kind in self.kinds]

    def fitted(self, offset: float, *, free: bool) -> _Fit | None:
        """Fit the offset and the lasting errors of the odometry, which are two scales and a rate of turns. None if the spans
        do not show them.

        offset: s, at which the fit begins. free: whether the offset is fitted. If not, it is held.
        """
        seconds = self.end - self.begin
        errors = np.array([offset, 0.0, 0.0, 0.0, 0.0, 0.0])  # The offset, two scales and the rate of turns (3,).
        for _ in range(_ROUNDS):
            off, slope, weight = self._linear(errors)
            weighed = slope * weight[:, :, None]
            normal = np.einsum("nia,nib->ab", weighed, slope) + np.diag(_LOOSE**-2)
            pull = np.einsum("nia,ni->na", weighed, off)
            step = np.linalg.solve(normal, pull.sum(axis=0) - errors * [0.0, *_LOOSE[1:] ** -2])
            if not free:
                rest = np.linalg.solve(normal[1:, 1:], pull[:, 1:].sum(axis=0) - errors[1:] * _LOOSE[1:] ** -2)
                step = np.append(0.0, rest)
            errors = errors + step
            if abs(errors[0] - offset) > 5 * _TRIED:
                return None
            if abs(step[0]) < _DELTA / 10 and not np.abs(step[1:]).max() > _DELTA:
                break
        block = np.floor(self.begin / max(_BLOCK, 2 * float(np.median(seconds)))).astype(np.int64)
        told = np.bincount(block - block[0], np.einsum("ni,ni->n", weighed[:, :, 0], slope[:, :, 0]))
        blocks = float(told.sum() ** 2 / (told**2).sum()) if told.sum() > 0 else 0.0
        if blocks < _FEWEST_BLOCKS:
            return None
        # The errors of neighbouring spans are alike (a sandwich estimate). A few blocks may be alike by chance, so the
        # standard deviation is at least that of as many independent spans as the time has.
        pulls = np.stack([np.bincount(block - block[0], one) for one in pull.T], axis=1)
        by_blocks = np.linalg.solve(normal, np.linalg.solve(normal, pulls.T @ pulls).T)[0, 0]
        independent = float(np.minimum(np.diff(self.begin, append=np.inf), seconds).sum() / seconds.mean())
        alone = np.linalg.inv(normal)[0, 0] * len(seconds) / independent
        cost = independent * sum(_width(lengths(off[:, kind])) for kind in self.kinds)
        variance = max(by_blocks, alone) * blocks / (blocks - 1) + _UNEVEN**2
        return _Fit(float(errors[0]), float(np.sqrt(variance)), float(cost))

    def _linear(self, errors: Floats) -> tuple[Floats, Floats, Floats]:
        """Return the differences (n, 6) between the two paths at errors (6,) of the odometry. Also return by how much the
        errors change the odometry (n, 6, 6), and the weights (n, 6)."""
        seconds, driven = self.end - self.begin, self.by_odometry(errors[0])
        scale = 1 + np.repeat(errors[1:3], 3)
        seen = scale * driven
        seen[:, :3] += errors[3:] * seconds[:, None]
        off = _unwrapped(self.told - seen)
        slope, weight = np.zeros((len(off), 6, 6)), np.zeros_like(off)
        slope[:, :, 0] = self.by_odometry(errors[0] + _DELTA) - self.by_odometry(errors[0] - _DELTA)
        slope[:, :, 0] *= scale / (2 * _DELTA)
        slope[:, :3, 1], slope[:, 3:, 2] = driven[:, :3], driven[:, 3:]
        slope[:, range(3), range(3, 6)] = seconds[:, None]
        for kind in self.kinds:
            weight[:, kind] = _weights(lengths(off[:, kind]), lengths(driven[:, kind]))[:, None]
        return off, slope, weight


def _unwrapped(off: Floats) -> Floats:
    """Return differences (n, 6) whose turns are reduced to at most half a turn. Between rare poses, a robot may turn by more
    than that."""
    angle = lengths(off[:, :3])
    less = angle - 2 * np.pi * np.round(angle / (2 * np.pi))
    off = off.copy()
    off[:, :3] *= np.divide(less, angle, out=np.ones_like(angle), where=angle > 0)[:, None]
    return off


def _weights(missed: Floats, driven: Floats) -> Floats:
    """Return Huber's weights (n,) of spans. missed: (n,) how far the paths differ in each span. driven: (n,) how far the
    odometry moves in each span."""
    moving = missed[driven > _MOVING]
    noise = max(float(np.median(moving)) / NORMAL_MEDIAN if len(moving) else 0.0, _FINEST)
    return np.asarray(np.minimum(1.0, HUBER_K * noise / np.maximum(missed, 1e-12)) / noise**2)


def _repeats(odometry: Trajectory, localization: Trajectory, max_gap: float) -> bool:
    """Return whether a localisation repeats the steps of the odometry. A particle filter on /tf does so between two
    corrections. Then both have one clock. The corrections come after the errors that they correct, so they look late."""
    at, covered = interpolate(odometry.stamps, odometry.poses, localization.stamps, max_gap)
    step, driven = (log_se3(inverse(path[:-1]) @ path[1:]) for path in (localization.poses[covered], at[covered]))
    size = lengths(driven)
    moving = size > STILL
    return bool(moving.any() and np.median(lengths(step - driven)[moving] / size[moving]) < _REPEATED)


def _width(missed: Floats) -> float:
    """Return the logarithm of the width of Laplace's distribution for the differences `missed` (n,). A few jumps hardly
    change it."""
    return float(np.log(np.minimum(missed, 20 * np.median(missed) + _FINEST).mean() + _FINEST))
