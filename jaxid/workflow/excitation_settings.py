"""Settings of the motion that identifies a robot, and of the search for it."""

import dataclasses
import math
from typing import Literal

import numpy as np

from jaxid.errors import InputError
from jaxid.excitation.criteria import CRITERIA, AbstractCriterion
from jaxid.robot.robot import Robot
from jaxid.trajectory.controllers import CONTROLLERS
from jaxid.trajectory.fourier import FourierBasis, RestToRestBasis
from jaxid.trajectory.lead_in_and_out import LeadsBasis
from jaxid.trajectory.spline import RestToRestSplineBasis
from jaxid.trajectory.trajectory import AbstractBasis, count_cycles

Corner = tuple[float, float, float]
HARMONICS = 5
"""Number of harmonics of the series of an arm."""
HARMONICS_ON_FEET = 20
"""The same of a robot on its feet: each phase is one period."""
SAMPLES = 800
"""Number of samples of one run of an arm."""
STEP_ON_FEET = 0.005
"""Time between two samples of a robot on its feet [s]."""


@dataclasses.dataclass(frozen=True)
class Leads:
    """Ways from standstill into a periodic motion, and out of it.

    Attributes:
        time: Duration of each, if they are designed together with the motion [s].
        periods: Number of periods between them.
    """

    time: float | None = None
    periods: int = 1


@dataclasses.dataclass(frozen=True)
class Excitation:
    """Motion that `jaxid excite` designs, within the limits above.

    Attributes:
        criterion: Objective: "d_optimal" for the smallest standard deviations overall,
            "condition_number" for the paper's (Eq. 36), or another criterion.
        harmonics: Number of harmonics of the Fourier series, like `8`; by default 5,
            and 20 of a robot on its feet.
        omega: Fundamental frequency of the series [rad/s].
        rest: Whether the motion starts and stops at rest.
        spline: Spline from rest to rest in place of a series, like
            `{ points = 12, duration = 8.0 }`.
        leads: Whether leads bring the robot from standstill into the periodic motion
            and back; or a table, like `{ time = 0.5, periods = 2 }`: their duration
            (they are then designed together with the motion) and the number of periods
            between them.
        samples: Number of samples that one run will measure; by default 800, and 200
            for each second of a robot on its feet.
        noise: Standard deviation of the forces' noise for each joint [N m or N]; by
            default 1 % of the largest forces.
        starts: Number of random motions to start from.
        generations: Number of rounds in which the best motions are recombined.
        time: Time for the search [s], like `60.0`; by default, all steps are done.
        seed: Seed of the random motions.
        sample_time: Time between two rows of the written table, the controller's cycle
            [s], like `0.004`; by default that of the controller, or of the samples.
        controller: Controller that plays the motion, for its cycle and its file:
            franka, kuka_fri, kuka_rsi or universal_robots, like `"universal_robots"`.
        ros: Kind of the file for ROS 2: "yaml" or "mcap" (a bag).
        nominal: Folder of an earlier result of `jaxid identify`, whose parameters are
            used to compute forces, like `"report"`.
        force_margin: Share of the largest forces to keep free, by nominal parameters,
            like `0.1`; by default 0.3 if friction or other parameters are unknown, else
            0.
        tip_speed: Largest speed of the end-effector [m/s], like `1.5`.
        tip_acceleration: Largest acceleration of the end-effector [m/s²], like `10.0`.
        workspace: Box for the end-effector: two corners [m], like
            `[[-1.0, -1.0, 0.1], [1.0, 1.0, 1.5]]`.
        pose: Angles [rad] in which a robot stands on its feet, of the joints whose
            names contain a word, like `{ thigh = 0.8, calf = -1.6 }`; by default a pose
            with bent knees is found.
        ground_friction: Coefficient of friction between its feet and the ground.
        support_margin: Least distance of its zero-moment point from the border of the
            feet that stand, relative to that of their middle.
        sole_radius: Radius of a circle about the point of a sole that surely touches
            the ground [m].
    """

    criterion: str = "d_optimal"
    harmonics: int | None = None
    omega: float = 0.8
    rest: bool = False
    spline: RestToRestSplineBasis | None = None
    leads: bool | Leads = True
    samples: int | None = None
    noise: list[float] | None = None
    starts: int = 32
    generations: int = 12
    time: float | None = None
    seed: int = 0
    sample_time: float | None = None
    controller: str | None = None
    ros: Literal["yaml", "mcap"] = "yaml"
    nominal: str | None = None
    force_margin: float | None = None
    tip_speed: float = math.inf
    tip_acceleration: float = math.inf
    workspace: tuple[Corner, Corner] | None = None
    pose: dict[str, float] | None = None
    ground_friction: float = 0.5
    support_margin: float = 0.35
    sole_radius: float = 0.03

    @property
    def objective(self) -> AbstractCriterion:
        """Criterion of that name."""
        return CRITERIA[self.criterion]

    @property
    def cycle(self) -> float | None:
        """Time between two rows of the table [s]; None for that of the samples."""
        if self.sample_time is None and self.controller is not None:
            return CONTROLLERS[self.controller].sample_time
        return self.sample_time

    @property
    def chosen_leads(self) -> Leads | None:
        """Ways into and out of the motion; None if it starts as it is."""
        if not self.leads or self.rest or self.spline is not None:
            return None
        return self.leads if isinstance(self.leads, Leads) else Leads()

    @property
    def rests(self) -> bool:
        """Whether the motion starts and ends at standstill, if leads are possible."""
        return self.chosen_leads is not None or self.rest or self.spline is not None

    def count_samples(self, robot: Robot) -> int:
        """Return the number of samples that one run will measure."""
        if self.samples is not None:
            return self.samples
        if not robot.floating:
            return SAMPLES
        phases = 1 + len(robot.contacts)
        return round(phases * 2 * np.pi / self.omega / STEP_ON_FEET)

    def basis(self, has_constraints: bool) -> AbstractBasis:
        """Return the basis of trajectories; if constrained, leads are designed, too.

        Raises:
            InputError: If two kinds are asked for, or one whose end no sample would
                meet.
        """
        if self.spline is not None:
            if self.rest:
                raise InputError(
                    "`rest` belongs to Fourier series, and a `spline` starts and ends "
                    "at rest anyway: leave one of them out."
                )
            return self.spline
        series = (self.harmonics or HARMONICS, self.omega)
        if self.rest:
            return RestToRestBasis(*series)
        leads = self.chosen_leads
        if leads is None and self.cycle is not None:
            self._require_whole_cycles(self.cycle)
        if leads is None or (not has_constraints and leads.time is None):
            return FourierBasis(*series)
        return LeadsBasis(*series, lead=leads.time or 0.5, periods=leads.periods)

    def _require_whole_cycles(self, cycle: float) -> None:
        """Reject samples at full speed that end before the period or go on after it."""
        period = 2 * np.pi / self.omega
        count = count_cycles(period, cycle)
        if abs(count * cycle - period) > 1e-6 * cycle:
            raise InputError(
                f"`sample_time` must divide the period of {period:.9g} s where there "
                f"are no `leads`: choose `omega` = {2 * np.pi / (count * cycle):.9g}, "
                "or use `leads`."
            )
