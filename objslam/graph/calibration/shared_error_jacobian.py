"""Build the linear system of a graph and its shared errors. It shows how the joint solution depends on the shared errors.

The shared errors are parameters, and not variables of the graph. Their columns of the Jacobian are finite differences of the
whitened residuals.
"""

from dataclasses import dataclass, replace
from typing import Self

import numpy as np
from scipy import sparse

from objslam.core.arrays import Floats, Ints
from objslam.core.calibration import CalibratedMeasurements
from objslam.graph.calibration.clock_instruments import ClockInstruments
from objslam.graph.calibration.instruments import ODOMETRY_SCALES, Motions, motion_instruments
from objslam.graph.calibration.linearised_graph import Linearised
from objslam.graph.calibration.parameter_columns import parameter_columns
from objslam.graph.least_squares.chain import ChainRows
from objslam.graph.least_squares.normal_equations import Equations


@dataclass(frozen=True)
class LinearSystem:
    """The whitened Jacobian and residuals of a graph and its shared errors. The robust weights are kept fixed.

    The rows are in the order of `Measurements.factors`: bearings, ranges, landmark priors, motions, absolute poses. The
    corners of fiducials are last. jacobian: (M, D) the derivatives of the rows by the variables: first three columns for
    each landmark, and after them six columns for each pose. sides: (M, P) the derivatives of the rows by the shared errors.
    instruments: (M, P) columns that replace the sides. At the optimum, the residuals do not correlate with the instruments.
    An instrument equals its side, except for clocks and for errors of the odometry, because the noise of the odometry is
    also in the residuals. residual: (M,). first_range, first_motion: the first rows of the ranges and of the motions.
    normal: the normal equations of the Jacobian. chain: as in `JointRows`. motions: None if neither the odometry nor a clock
    has a parameter. clocks: None without a clock. by_path: (M, C) the instruments of the C clocks by the solved path. noise:
    (P, P) from `noise_shares`, the shares of noise in the information. longer: (P,) the ratio of the odometry's noise in the
    residuals to the noise in the side of a scale, 0 for other parameters.
    """

    jacobian: sparse.csr_matrix
    sides: Floats
    instruments: Floats
    residual: Floats
    first_range: int
    first_motion: int
    normal: Equations
    chain: ChainRows | None
    motions: Motions | None
    clocks: ClockInstruments | None
    by_path: Floats
    noise: Floats
    longer: Floats

    def with_noise(self, noise: Floats) -> Self:
        """Return the system for shares `noise` (P, P) of noise in its sides. The shares change the instruments of clocks."""
        instruments, columns = self.instruments.copy(), [] if self.clocks is None else list(self.clocks.moved)
        sides = self.sides[:, columns]
        instruments[:, columns] = sides + (self.by_path - sides) @ noise[np.ix_(columns, columns)]
        return replace(self, instruments=instruments, noise=noise)

    def left(self, columns: Floats) -> Floats:
        """Return the residuals of columns (M, n) after a least-squares fit by poses and landmarks."""
        return columns - self.jacobian @ self.normal.solve(self.jacobian.T @ columns)

    def reduce(self) -> "ReducedSystem":
        """Return the system with poses and landmarks eliminated (Schur complement), without the expected products of
        noise."""
        own = np.flatnonzero((self.instruments != self.sides).any(axis=0))
        columns = np.column_stack([self.sides, self.residual, self.instruments[:, own]])
        changes = -self.normal.solve(self.jacobian.T @ columns)
        left = columns + self.jacobian @ changes
        count = self.sides.shape[1]
        sides, residual, instruments = left[:, :count], left[:, count], left[:, :count].copy()
        instruments[:, own] = left[:, count + 1 :]
        information, variance, slope = sides.T @ sides, instruments.T @ instruments, instruments.T @ sides
        noise = np.diag(np.diagonal(self.noise) * np.diagonal(information))
        gradient = -instruments.T @ residual + np.diagonal(noise) * self.longer
        if self.clocks is not None:
            moved = np.array(list(self.clocks.moved))
            others, block = np.setdiff1d(np.arange(count), moved), np.ix_(moved, moved)
            shares = self.noise[block]
            poses = len(self.clocks.seconds)
            velocity = self.clocks.changes(changes[-6 * poses :, :count].reshape(poses, 6, count))
            # The side of a clock can be mostly noise. So the clock's instrument replaces it in products with others.
            slope[others[:, None], moved] = variance[others[:, None], moved]
            # The path, and with it the instrument, depends on the parameters too. Without this part, the noise that the path
            # and the side have in common would be in the slope.
            slope[moved] += shares.T @ [self.clocks.products(residual, k, velocity) for k in moved]
            noise[block] = (np.eye(len(moved)) - shares).T @ information[block] @ shares
        return ReducedSystem(
            information=information,
            slope=slope - noise,
            variance=variance,
            gradient=gradient,
            descent=-sides.T @ residual,
            sensitivity=changes[:, :count],
            newton=changes[:, count],
        )


@dataclass(frozen=True)
class ReducedSystem:
    """The normal equations of the parameters with poses and landmarks eliminated.

    information: (P, P) the curvature of the cost. descent: (P,) the negative gradient of the cost. gradient: (P,) minus the
    products of the instruments and the residuals, zero at the optimum. slope: (P, P) the decrease of the gradient by each
    parameter. The expected products of noise are removed from the gradient and from the slope. variance: (P, P) the variance
    of the gradient by white noise. sensitivity: (D, P) the derivatives of all variables at their optimum by the parameters.
    It has three rows for each landmark, and after them six rows for each pose. newton: (D,) the remaining Newton step of the
    variables.
    """

    information: Floats
    slope: Floats
    variance: Floats
    gradient: Floats
    descent: Floats
    sensitivity: Floats
    newton: Floats

    def take(self, parameters: Ints) -> Self:
        """Return the system of some parameters (n,) alone."""
        block = np.ix_(parameters, parameters)
        return replace(
            self,
            information=self.information[block],
            slope=self.slope[block],
            variance=self.variance[block],
            gradient=self.gradient[parameters],
            descent=self.descent[parameters],
            sensitivity=self.sensitivity[:, parameters],
        )

    def with_wider(self, factors: Floats | None) -> Self:
        """Return the system with the standard deviations of its gradient multiplied by `factors` (P,). None means 1."""
        return self if factors is None else replace(self, variance=self.variance * np.outer(factors, factors))


def linearise(of: Linearised, errors: CalibratedMeasurements, theta: Floats, noise: Floats | None = None) -> LinearSystem:
    """Return the linear system of a graph at its values and at the shared errors theta (P,).

    noise: (P, P) from `noise_shares`. None means that the sides have no noise. SolveError if the system is singular.
    """
    graph, rows = of.graph, of.rows
    sides, moved, across = parameter_columns(of, errors, theta)
    asked = bool(moved) or any(name.startswith("odometry.") for name in errors.names)
    motions = Motions.of(of) if asked and len(graph.motion_roots) else None
    clocks = ClockInstruments.of(of, moved, motions, across) if moved else None
    by_path = sides[:, list(moved)]
    for i, k in enumerate(moved):
        assert clocks is not None
        clocks.put(by_path[:, i : i + 1], k, clocks.velocity[..., None])
    found = LinearSystem(
        jacobian=rows.jacobian,
        sides=sides,
        instruments=motion_instruments(motions, errors.names, sides),
        residual=rows.residual,
        first_range=graph.first_range,
        first_motion=graph.first_motion,
        normal=of.normal,
        chain=rows.chain,
        motions=motions,
        clocks=clocks,
        by_path=by_path,
        noise=np.zeros((len(theta), len(theta))),
        longer=np.where([name in ODOMETRY_SCALES for name in errors.names], 1 + theta, 0.0),
    )
    return found if noise is None else found.with_noise(noise)
