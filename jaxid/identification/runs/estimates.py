"""Estimates for comparisons: numbers with names, units and their covariance."""

import dataclasses
import re
from collections.abc import Iterable, Sequence

import equinox as eqx
import numpy as np
from scipy import stats

from jaxid.arrays import AnyArray, Float
from jaxid.dynamics.base import BaseParameters
from jaxid.identification.fit import Fit
from jaxid.identification.uncertainty import Uncertainty
from jaxid.table import Column, Remark, Table, with_deviations


class Estimates(eqx.Module):
    """Estimated parameters and their uncertainty.

    Attributes:
        label: Name of their run, such as `cold`.
        names: Names of the parameters.
        expressions: What each parameter is made of, in letters; its name where nobody knows.
        units: Units of the parameters.
        groups: The kind of each parameter, such as `viscous friction`.
        parameters: The estimates.
        covariance: Covariance of the estimates; infinite on the diagonal where nothing is known.
        freedom: Degrees of freedom of each standard deviation; infinite where it is taken as exact.
    """

    label: str = eqx.field(static=True)
    names: tuple[str, ...] = eqx.field(static=True)
    expressions: tuple[str, ...] = eqx.field(static=True)
    units: tuple[str, ...] = eqx.field(static=True)
    groups: tuple[str, ...] = eqx.field(static=True)
    parameters: Float[AnyArray, " parameters"]
    covariance: Float[AnyArray, "parameters parameters"]
    freedom: Float[AnyArray, " parameters"]

    @classmethod
    def of(cls, fit: Fit, label: str | None = None) -> "Estimates":
        """The estimates of a fit.

        Args:
            fit: The fit.
            label: Name of the run; the names of its recordings if None.
        """
        base = fit.base
        return cls(
            label=", ".join(fit.recordings) if label is None else label,
            names=base.names,
            expressions=base.names,
            units=base.units,
            groups=groups(base),
            parameters=np.asarray(fit.parameters),
            covariance=np.asarray(fit.covariance),
            freedom=freedom_of(fit),
        )

    def only(self, chosen: Sequence[int]) -> "Estimates":
        """Some of the parameters.

        Args:
            chosen: Their indices.
        """
        k = np.array(chosen, int)
        texts = {
            key: tuple(getattr(self, key)[i] for i in k)
            for key in ("names", "expressions", "units", "groups")
        }
        return Estimates(
            label=self.label,
            **texts,
            parameters=np.asarray(self.parameters)[k],
            covariance=np.asarray(self.covariance)[np.ix_(k, k)],
            freedom=np.asarray(self.freedom)[k],
        )

    @property
    def standard_deviations(self) -> Float[np.ndarray, " parameters"]:
        """Standard deviations of the estimates."""
        return np.sqrt(np.diag(self.covariance))

    def half_widths(self, level: float) -> Float[np.ndarray, " parameters"]:
        """Half the widths of the estimates' intervals, each for itself.

        Args:
            level: Confidence, of 1.
        """
        quantile = stats.t.ppf(0.5 + 0.5 * level, np.asarray(self.freedom))
        return quantile * self.standard_deviations

    def summary(
        self, title: str = "", remarks: Iterable[Remark] = (), level: float = 0.95
    ) -> Table:
        """Return a table of the estimates with their intervals.

        Args:
            title: Title of the table.
            remarks: Remarks below the table.
            level: Confidence of the intervals (0 to 1).
        """
        values, halves = with_deviations(self.parameters, self.half_widths(level))
        return Table(
            title,
            Column("parameter", self.names),
            Column("estimate", values, kind="number"),
            Column(f"± ({100 * level:g} %)", halves, kind="number"),
            Column("unit", self.units),
            remarks=remarks,
        )


def groups(base: BaseParameters) -> tuple[str, ...]:
    """For each base parameter the effect that its leading parameter belongs to, in words."""
    model = base.model
    words = [_words(type(term).__name__) for term in model.terms]
    of = [
        word
        for word, term in zip(words, model.terms, strict=True)
        for _ in term.parameters(model.robot)
    ]
    return tuple(of[k] for k in base.indices)


def _words(name: str) -> str:
    """`ViscousFriction` as `viscous friction`."""
    return re.sub(r"(?<=[a-z])(?=[A-Z])", " ", name).lower()


def freedom_of(fit: Fit) -> Float[np.ndarray, " base"]:
    """Degrees of freedom of a fit's standard deviations."""
    return np.asarray(fit.uncertainty.dof)


def with_covariance(
    fit: Fit,
    parameters: Float[AnyArray, " base"],
    covariance: Float[AnyArray, "base base"],
    freedom: Float[AnyArray, " base"],
) -> Fit:
    """A fit with estimates and an uncertainty that were found in another way."""
    known = fit.uncertainty
    found = Uncertainty(np.asarray(covariance), np.asarray(freedom), known.naive_covariance)
    notes = tuple(note for note in fit.notes if note not in known.notes)
    return dataclasses.replace(
        fit, parameters=np.asarray(parameters), uncertainty=found, notes=notes
    )
