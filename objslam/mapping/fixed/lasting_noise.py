"""Estimate the errors of given poses that last for some seconds, from the rays of all objects together.

An object that was seen only for a few seconds hides the errors that the poses have in this time. Its place is fitted to the
errors, so its own rays miss it by little. But the same errors turn the rays to every object seen in these seconds. Each
object can hide only what a shift of this object explains. So all objects together show the errors."""

from dataclasses import dataclass

import numpy as np

from objslam.core.arrays import Floats, Ints
from objslam.errors import SolveError

TIMES = (1.0, 4.0, 16.0, 64.0)
"""The tried correlation times (s) of lasting errors. After this time, the correlation is 1/e. The shortest time fits a jump
of a scan matcher, and the longest fits an error of the map around a place. With more times, the estimate is more exact and
slower."""
_FACTORS = np.append(0.0, np.geomspace(0.1, 20.0, 40))
"""The tried standard deviations of lasting errors, as multiples of the noise of the poses. With more factors, the estimate
is more exact and slower."""
_KINDS = np.array([[1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])
"""The tried mixtures of errors, one a row: only rotations err, rotations and places err by one factor, or only places err.
With more mixtures, the estimate is more exact and slower."""
_LOOSE = 1.0
"""The prior standard deviation (m) of the error of a solved position. With a larger value, the rays decide more."""
_MOST = 400
"""The most cells that count. Some hundred cells determine the factor to a few percent. The time of the estimate grows with
the cube of this number."""
_TOGETHER = 50
"""The number of cells in a stretch. If there are more than `_MOST` cells, only some stretches count. A stretch has cells
that follow each other in time, because only cells of the same seconds share their errors. Longer stretches show errors that
last longer, but cover fewer parts of the drive."""


@dataclass(frozen=True)
class Cells:
    """The misses of the rays of objects along one axis, in C cells. A cell holds the rays of one object in a short time. The
    cells are in the order of their objects.

    owner: (C,) the object of each cell. times: (C,) s, the mean time of the rays. mean: (C,) rad, the mean angle by which
    the rays pass the object to the left, or above it. white: (C,) rad, the standard deviation of the mean from noise that
    does not last. shift: (C, n) rad per m, the derivative of the mean by n coordinates of the object. turn: (C, 3) rad, the
    error of the mean if the poses are turned about each axis by one standard deviation. move: (C, 3) rad, the error of the
    mean if the poses are shifted along each axis by one standard deviation. pull: (C, 3) m per rad, the derivative of the
    object's position by the mean.
    """

    owner: Ints
    times: Floats
    mean: Floats
    white: Floats
    shift: Floats
    turn: Floats
    move: Floats
    pull: Floats

    def take(self, which: Ints) -> "Cells":
        """Return the cells `which`."""
        return Cells(*(column[which] for column in vars(self).values()))

    def alike(self, time: float) -> Floats:
        """Return the correlations (C, C) of errors with the correlation time `time`, s."""
        return np.asarray(np.exp(-np.abs(self.times[:, None] - self.times) / time))

    def covariances(self, variances: Floats) -> tuple[Ints, Floats]:
        """Return the objects (N,) that have cells, and the covariance (N, 3, 3) m^2 that lasting errors add to each
        position.

        variances: (2, T) as in `lasting_variances`.
        """
        objects, first = np.unique(self.owner, return_index=True)
        found = np.zeros((len(objects), 3, 3))
        for j, mine in enumerate(np.split(np.arange(len(self.owner)), first[1:])):
            cells = self.take(mine)
            kernel = sum(cells._errors(each) * cells.alike(time) for each, time in zip(variances.T, TIMES, strict=True))
            found[j] = cells.pull.T @ kernel @ cells.pull
        return objects, found

    def _errors(self, squared: Floats) -> Floats:
        """Return the covariances (C, C) rad^2 of the misses, if all poses have the same error. squared: (2,) the squared
        factors on the noise of rotations and of places."""
        return np.asarray(squared[0] * self.turn @ self.turn.T + squared[1] * self.move @ self.move.T)


@dataclass(frozen=True)
class LastingNoise:
    """The errors of given poses that last. yaw: rad, the standard deviation of headings. xy: m, the standard deviation of
    places. seconds: the mean correlation time, s. objects: the number of objects that show the errors."""

    yaw: float
    xy: float
    seconds: float
    objects: int

    @classmethod
    def of(cls, cells: Cells, variances: Floats, yaw: float, place: float) -> "LastingNoise":
        """Return the errors that belong to squared factors. variances: (2, T) as in `lasting_variances`. yaw, place: the
        noise (rad, m) to which the factors apply."""
        turned, moved = np.sqrt(variances.sum(axis=1)).tolist()
        weight = variances.sum(axis=0)
        seconds = float(np.exp(weight @ np.log(TIMES) / weight.sum())) if weight.sum() > 0 else 0.0
        return cls(turned * yaw, moved * place, seconds, len(np.unique(cells.owner)))


def lasting_variances(cells: Cells) -> Floats:
    """Return the expected squared factors (2, T) on the noise of rotations and of places, for each correlation time in
    `TIMES`. The sum over the times is the squared factor of all lasting errors.

    The prior of the factor is half-normal, with the scale 1. The likelihood is restricted (Patterson and Thompson 1971),
    which means that the errors of all positions are integrated out. The mixture, the factor and the correlation time are
    averaged over their posterior. SolveError if the likelihood is not finite.
    """
    cells = cells.take(_counted(cells.times))
    from scipy.linalg.lapack import dpotrf, dsygst, dtrtrs  # Here, so that `load_libraries` comes first.

    same = cells.owner[:, None] == cells.owner
    known = np.diag(cells.white**2) + _LOOSE**2 * np.where(same, cells.shift @ cells.shift.T, 0.0)
    root, failed = dpotrf(np.asfortranarray(known), lower=1, overwrite_a=1)
    mean, squared = dtrtrs(root, cells.mean, lower=1)[0], _FACTORS**2
    likelihood = np.tile(-0.5 * squared, (len(_KINDS), len(TIMES), 1))
    kinds = [cells._errors(one) for one in np.eye(2)]
    for column, time in enumerate(TIMES):
        alike = cells.alike(time)
        # The errors in units of the known noise, L^-1 E L^-T. LAPACK makes the lower triangles, and reads columns.
        turned, moved = (dsygst((errors * alike).T, root, itype=1, lower=1, overwrite_a=1)[0] for errors in kinds)
        for row, (turns, moves) in zip(likelihood[:, column], _KINDS.tolist(), strict=True):
            row -= 0.5 * _misfits(turns * turned + moves * moved, mean, squared)
    if failed or not np.isfinite(likelihood).all():  # LAPACK does not report a NaN.
        raise SolveError("the errors of the poses that last cannot be estimated, because the misses are not finite")
    weight = np.exp(likelihood - likelihood.max()) * np.gradient(_FACTORS)
    return np.asarray(np.einsum("mtf,f,mk->kt", weight, squared, _KINDS) / weight.sum())


def _misfits(covariance: Floats, mean: Floats, factors: Floats) -> Floats:
    """Return -2 ln of the likelihood (F,), up to a constant, for each factor f (F,). A mean (C,) has the covariance 1 + f
    times `covariance`.

    covariance: (C, C) symmetric. Only the lower triangle counts, and this call overwrites it. The matrix is made tridiagonal
    once. Then all factors together are one tridiagonal system. This takes a third of the time of eigenvalues with their
    vectors.
    """
    from scipy.linalg import eigh_tridiagonal
    from scipy.linalg.lapack import dormqr, dptsv, dsytrd, dsytrd_lwork  # Here, so that `load_libraries` comes first.

    diagonal, beside, count = np.diagonal(covariance), np.zeros(0), len(mean)
    if count > 1:
        space = int(dsytrd_lwork(count, lower=1)[0])
        reflectors, diagonal, beside, scales, _ = dsytrd(covariance, lower=1, lwork=space, overwrite_a=1)
        turned = dormqr("L", "T", reflectors[1:, :-1], scales, mean[1:, None], space)[0][:, 0]
        mean = np.append(mean[0], turned)
    right = np.tile(mean, len(factors))
    of_all = (1 + np.outer(factors, diagonal)).ravel(), np.outer(factors, np.append(beside, 0.0)).ravel()[:-1]
    pivots, _, solved, failed = dptsv(*of_all, right)
    if failed:  # Rounding made an eigenvalue so negative that the sum is not positive definite.
        size, vectors = eigh_tridiagonal(diagonal, beside)
        variance = 1 + factors[:, None] * np.maximum(size, 0.0)
        return np.asarray(((vectors.T @ mean) ** 2 / variance + np.log(variance)).sum(axis=1))
    return np.asarray((right * solved + np.log(pivots)).reshape(len(factors), count).sum(axis=1))


def _counted(times: Floats) -> Ints:
    """Return the indices of the cells that count, in ascending order. These are all cells, or the cells of stretches that
    are spread evenly over the time."""
    if len(times) <= _MOST:
        return np.arange(len(times))
    stretches = np.array_split(np.argsort(times, kind="stable"), -(-len(times) // _TOGETHER))
    some = np.linspace(0, len(stretches) - 1, _MOST // _TOGETHER).round().astype(np.int64)
    return np.sort(np.concatenate([stretches[i] for i in some]))
