"""Methods that identify from torques and positions, compared on logs that none has seen."""

import dataclasses
from collections.abc import Callable, Sequence

import numpy as np

from jaxid.arrays import Float
from jaxid.dynamics.motion import Motion
from jaxid.identification.estimators import InstrumentalVariables
from jaxid.identification.identify import identify
from jaxid.measurement.observations import Observations
from jaxid.result_table import Column, Status, Summarised, Table

from .torque import TorqueRolloutFit

ROUNDS = 8
"""Largest number of simulations with the parameters of the last one."""
METHODS = ("least squares", "instrumental variables", "DIDIM", "rollouts")
"""Methods in the order of the results."""


@dataclasses.dataclass(frozen=True)
class MethodComparison(Summarised):
    """Errors of several methods that were given the same logs.

    Attributes:
        joint_names: Names of the joints.
        parameters: Base parameters of each of `METHODS`; NaN where a simulation
            diverged.
        horizons: Lengths of the windows [s].
        errors: Root mean square errors at the ends of windows [rad or m].
        torque_errors: Root mean square errors of torques at the measured motion [N m or
            N].
        unseen: Whether no method has seen the logs of the errors.
    """

    joint_names: tuple[str, ...]
    parameters: Float[np.ndarray, "methods base"]
    horizons: tuple[float, float]
    errors: Float[np.ndarray, "methods horizons joints"]
    torque_errors: Float[np.ndarray, "methods joints"]
    unseen: bool

    @property
    def best(self) -> str:
        """Method whose errors at the longest horizon have the smallest geometric mean."""
        sizes = np.log(self.errors[:, -1]).mean(axis=1)
        return METHODS[int(np.nanargmin(sizes))]

    def summary(self) -> Table:
        """Return a table with the methods of each joint below each other."""
        n, count = len(self.joint_names), len(METHODS)
        least = np.nanargmin(self.errors[:, -1], axis=0)
        where = (
            "logs that no method has seen" if self.unseen else "the logs of the fits"
        )
        return Table(
            f"errors on {where}",
            Column("joint", [name for name in self.joint_names for _ in METHODS]),
            Column("method", METHODS * n),
            *(
                Column(
                    f"position\nafter {h:g} s",
                    1e3 * self.errors[:, k].T.ravel(),
                    "mrad or mm",
                )
                for k, h in enumerate(self.horizons)
            ),
            Column("torque", self.torque_errors.T.ravel(), "N m or N"),
            status=[
                Status.GOOD if m == least[j] else Status.NEUTRAL
                for j in range(n)
                for m in range(count)
            ],
            rules=[count * j for j in range(1, n)],
        )


def compare_methods(
    fit: TorqueRolloutFit,
    identification: Sequence[Observations],
    unseen: Sequence[Observations],
) -> MethodComparison:
    """Compare rollouts with methods for the same model and logs.

    Least squares at the measured motion (`identify`); instrumental variables, whose
    instruments are the columns at a simulated motion (Janot, Vandanjon, Gautier 2014);
    least squares at the simulated motion (DIDIM: Gautier, Janot, Vandanjon 2013). The
    torques of the log drive this simulation, and a controller of the bandwidth 2 /
    horizon keeps it near the measured motion: without it, in windows, the simulated
    motion fits the torques with any parameters.

    Args:
        fit: Fit of rollouts.
        identification: Logs of this fit.
        unseen: Other logs, for the errors; those of the fit if there are none.
    """
    base, logs = fit.rollout.base, tuple(identification)

    def instrumental(motions: tuple[Motion, ...]) -> np.ndarray:
        return np.asarray(
            identify(base, logs, InstrumentalVariables(motions)).parameters
        )

    def didim(motions: tuple[Motion, ...]) -> np.ndarray:
        simulated = [o.replace(motion=m) for o, m in zip(logs, motions, strict=True)]
        return np.asarray(identify(base, simulated).parameters)

    others = [fit.start, *(_iterated(fit, logs, f) for f in (instrumental, didim))]
    given, judged = [*others, None], tuple(unseen) or logs
    horizons = 0.5 * fit.horizon, fit.horizon
    return MethodComparison(
        base.model.robot.joint_names,
        np.stack([*others, fit.parameters]),
        horizons,
        np.array([[fit.errors_at(judged, h, p) for h in horizons] for p in given]),
        np.array([fit.torque_errors(judged, p) for p in given]),
        bool(unseen),
    )


def _iterated(
    fit: TorqueRolloutFit,
    logs: Sequence[Observations],
    estimate: Callable[[tuple[Motion, ...]], np.ndarray],
) -> np.ndarray:
    """Return estimates from motions that are simulated with the estimates themselves."""
    p = fit.start
    for _ in range(ROUNDS):
        motions = fit.rollout.follow(p, logs, 2.0 / fit.horizon)
        if not all(np.isfinite(m.qdd).all() for m in motions):
            return np.full_like(p, np.nan)
        last, p = p, estimate(motions)
        if np.linalg.norm(p - last) < 1e-3 * np.linalg.norm(p):
            break
    return p
