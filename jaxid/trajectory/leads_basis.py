"""Periodic motions with leads of a given time, linear in the series' numbers: for designs."""

import math

import equinox as eqx
import numpy as np

from jaxid.arrays import AnyArray, Float
from jaxid.errors import InputError
from jaxid.trajectory.basis import AbstractBasis, Envelope, FourierBasis
from jaxid.trajectory.leads import WithLeads

DEGREE = 4
"""Of the polynomials in a lead."""
PIECES = 8
"""Pieces of a lead, each of which is bounded by its own control points."""


class LeadsBasis(AbstractBasis):
    """Fourier series with a lead-in and a lead-out: numbers are those of the series.

    All joints start together and take the time `lead` into the series, and out of it in the end.
    Limits and constraints hold in the leads as well, other than with `with_leads`, which finds
    leads for a motion that is there already. What is measured is one period between the leads.

    Attributes:
        harmonics: Number of harmonics.
        omega: Ground frequency [rad/s].
        lead: Time of a lead [s].
        periods: Between the leads.
        duration: From standstill to standstill [s].
    """

    harmonics: int = eqx.field(static=True)
    omega: float = eqx.field(static=True)
    lead: float = eqx.field(static=True)
    periods: int = eqx.field(static=True)
    duration: float = eqx.field(static=True)

    def __init__(self, harmonics: int, omega: float, *, lead: float = 0.5, periods: int = 1):
        series = FourierBasis(harmonics, omega)
        if not 0 < lead < math.inf:
            raise InputError(f"`lead` must be a positive time [s], but is {lead:g}.")
        if periods < 1:
            raise InputError(f"`periods` must be at least 1, but is {periods}.")
        self.harmonics, self.omega = harmonics, series.omega
        self.lead, self.periods = float(lead), periods
        self.duration = periods * series.duration + 2 * self.lead

    @property
    def series(self) -> FourierBasis:
        """The series between the leads."""
        return FourierBasis(self.harmonics, self.omega)

    def rows(self, t: Float[AnyArray, " samples"]) -> Float[np.ndarray, "4 samples variables"]:
        """The series, or the polynomials that lead into it and out of it."""
        t = np.asarray(t, np.float64)
        early, late = t < self.lead, t > self.duration - self.lead
        inner = self.series.rows(t - self.lead)
        outer = np.where(late[None, :, None], self._lead_out(t), inner)
        return np.where(early[None, :, None], self._lead_in(t), outer)

    def _lead_in(self, t: np.ndarray) -> np.ndarray:
        """Rows of the polynomials that lead into the series."""
        _, qd, qdd, _ = self.series.rows(np.zeros(1))[:, 0]
        return self._lead(qd, qdd, t)

    def _lead_out(self, t: np.ndarray) -> np.ndarray:
        """Rows of a lead-in that is run backwards."""
        _, qd, qdd, _ = self.series.rows(np.zeros(1))[:, 0]
        signs = np.array([1.0, -1.0, 1.0, -1.0])[:, None, None]
        return signs * self._lead(-qd, qdd, self.duration - t)

    def _lead(self, qd: np.ndarray, qdd: np.ndarray, t: np.ndarray) -> np.ndarray:
        """Rows of a lead that ends with this velocity and acceleration, from its start."""
        T, x = self.lead, t[:, None]
        alpha, beta = 3 * qd / T**2 - qdd / T, qdd / T**2 - 2 * qd / T**3
        there = self.series.rows(np.zeros(1))[0]
        travelled = alpha * (x**3 - T**3) / 3 + beta * (x**4 - T**4) / 4
        return np.stack(
            [
                there + travelled,
                alpha * x**2 + beta * x**3,
                2 * alpha * x + 3 * beta * x**2,
                2 * alpha + 6 * beta * x,
            ]
        )

    def envelope(self, points: int) -> Envelope:
        """Samples of a period, as for any series, and control points of the leads.

        A polynomial lies within the range of its control points (Bernstein).
        """
        rows, factor = self.series.envelope(points)
        u = np.linspace(0.0, 1.0, DEGREE + 1)
        order = np.arange(DEGREE + 1)
        weights = np.array([math.comb(DEGREE, k) for k in order])
        to_points = np.linalg.inv(
            weights * u[:, None] ** order * (1 - u[:, None]) ** (DEGREE - order)
        )
        piece = self.lead / PIECES
        leads = []
        for start in piece * np.arange(PIECES):
            t = start + piece * u
            leads += [to_points @ self._lead_in(t), to_points @ self._lead_out(self.duration - t)]
        return Envelope(
            tuple(np.concatenate(parts) for parts in zip(rows, *leads, strict=True)), factor
        )

    def trajectory(self, x: Float[AnyArray, "joints variables"]) -> WithLeads:
        """The series of these numbers between its leads."""
        series = self.series.trajectory(x)
        lead = np.full(len(x), self.lead)
        return WithLeads(series, 0.0, self.periods * self.series.duration, lead, lead)

    def times(self, samples: int) -> Float[np.ndarray, " samples"]:
        """Equidistant times over one period between the leads [s]."""
        return self.lead + self.series.times(samples)

    def instants(self, points: int) -> Float[np.ndarray, " points"]:
        """Equidistant times over the leads and one period [s]."""
        period = self.series.duration
        t = np.arange(points) * ((period + 2 * self.lead) / (points - 1))
        return np.where(t > self.lead + period, t + (self.periods - 1) * period, t)
