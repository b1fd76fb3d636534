"""What the demo has found, as tables for the terminal and the page; the paper's numbers beside."""

from typing import NamedTuple

import numpy as np

from jaxid.experiment.demo.study import OMEGA, SAMPLES, Judged, Study
from jaxid.identification.fit import Fit
from jaxid.report.numbers import significant, with_deviation

ASKED = 1.0
"""Average error of each axis that the paper stays below [% of the largest torque]."""


class Grid(NamedTuple):
    """A table of texts: names in the first column, numbers in the others.

    Attributes:
        title: Above it.
        columns: Heads.
        rows: As many texts each as there are columns.
    """

    title: str
    columns: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]


class Published(NamedTuple):
    """A base parameter of which the paper gives numbers.

    Attributes:
        number: As the paper counts, from 1.
        cold: Right after the start.
        warm: At operating temperature.
        unit: Of both.
    """

    number: int
    cold: float
    warm: float
    unit: str


NOTHING = "–"  # noqa: RUF001
"""In the place of a number that there is not."""
TEMPERATURE = (
    Published(1, 273.40, 273.62, "kg"),
    Published(2, 1.68, 1.65, "kg m"),
    Published(27, 248.41, 90.19, "N s/m"),
    Published(28, 41.26, 25.65, "N m s"),
    Published(34, 312.50, 233.00, "N"),
    Published(35, 18.24, 15.07, "N m"),
)
"""Section 6 of the paper."""


def beside_paper(study: Study) -> Grid:
    """What the paper says beside what came out here."""
    base, excitation = study.base, study.excitation
    robot = base.model.robot
    worst = [max(errors(study.weighted, k)) for k in (0, 1)]
    rows = [
        ("parameters, all of them", "70", str(base.model.size)),
        ("base parameters", "44", str(base.size)),
        ("p_B(1) (Eq. 24)", "m1 + m2 + m3 - m4 rc4z / l3z + I1", base.expressions[0]),
        ("p_B(2) (Eq. 24)", "m2 rc2x + l2x m3 - l2x m4 rc4z / l3z", base.expressions[1]),
        ("lengths in it [m]", "l2x, l3z", _lengths(study)),
        ("speed of the end-effector, up to [m/s]", "2.7", significant(excitation.speed)),
        (
            "acceleration of the end-effector, up to [m/s²]",
            "11.3",
            significant(excitation.acceleration),
        ),
        (
            "average error, worst axis, identification [%]",
            "below 1",
            significant(worst[0], 2),
        ),
        ("average error, worst axis, verification [%]", "below 1", significant(worst[1], 2)),
        (
            "the same while the axis moves [%]",
            NOTHING,
            significant(max(moving_errors(study, study.weighted, 1)), 2),
        ),
        (
            "verification, by the true parameters [%]",
            NOTHING,
            significant(max(errors(study.true, 1)), 2),
        ),
        ("mass matrix without weights", "not positive definite", _definite(study.unweighted)),
        ("mass matrix with weights", "positive definite", _definite(study.weighted)),
        ("mass matrix, consistent bodies", "not done", _definite(study.consistent)),
    ]
    for p in TEMPERATURE:
        for name, value, fit in (
            ("cold", p.cold, study.weighted.fit),
            ("warm", p.warm, study.warm),
        ):
            rows.append(
                (
                    f"p_B({p.number}), {name} [{p.unit}]",
                    f"{value:.2f}",
                    estimate(fit, p.number - 1),
                )
            )
    timed = study.timing
    if not isinstance(timed, str):
        rows += [
            ("feed-forward, Eq. 39 as printed [µs]", "11.928", _micro(timed.literal)),
            ("feed-forward, Eq. 38 [µs]", "15.243", _micro(timed.full)),
            ("Eq. 39 as printed over Eq. 38", "0.78", significant(timed.ratio, 2)),
            ("feed-forward, Eq. 39 factored [µs]", NOTHING, _micro(timed.factored)),
            ("computed by", "PC, 2.16 GHz", timed.where),
        ]
    return Grid(
        f"the paper, and what came out on the virtual {robot.name}",
        ("quantity", "paper", "here"),
        tuple(rows),
    )


def criteria(study: Study) -> Grid:
    """Both designs beside a random motion, by all criteria."""
    plans = study.excitation.plans
    rows = [
        (row[0].name, significant(row[0].before), *(significant(one.after) for one in row))
        for row in zip(*(plan.criteria for plan in plans), strict=True)
    ]
    gains = (significant(plan.mean_gain) for plan in plans)
    rows.append(("standard deviations, times smaller than random", "1", *gains))
    clear = (NOTHING, *("yes" if plan.feasible else "no" for plan in plans))
    rows.append(("keeps all limits, no collision", *clear))
    return Grid(
        f"motions to identify with: {SAMPLES} samples of a period of {2 * np.pi / OMEGA:.3f} s",
        ("criterion (small is good)", "random", *(plan.criterion.name for plan in plans)),
        tuple(rows),
    )


def average_errors(study: Study, recording: int) -> Grid:
    """Average errors of all axes in percent of the largest torque (Fig. 10).

    Args:
        study: What was found.
        recording: 0 for identification, 1 for verification.
    """
    judged = (study.unweighted, study.weighted, study.consistent, study.true)
    columns = [errors(one, recording) for one in judged]
    columns.append(moving_errors(study, study.weighted, recording))
    robot = study.base.model.robot
    rows = [
        (name, *(significant(column[j], 2) for column in columns))
        for j, name in enumerate(robot.joint_names)
    ]
    rows.append(("worst", *(significant(max(column), 2) for column in columns)))
    heads = (one.name.replace(" ", "\n") for one in judged)
    role = ("identification", "verification")[recording]
    return Grid(
        f"average error on {role} [% of the largest torque] (Fig. 10)",
        ("axis", *heads, "weighted,\nmoving"),
        tuple(rows),
    )


def temperature(study: Study) -> Grid:
    """Cold and warm parameters that the paper gives (Sec. 6), and what the virtual robot has."""
    fits, truth = (study.weighted.fit, study.warm), study.truth
    rows = []
    for p in TEMPERATURE:
        k = p.number - 1
        cold, warm = (estimate(f, k) for f in fits)
        rows.append(
            (
                f"p_B({p.number}) = {study.base.expressions[k]} [{p.unit}]",
                f"{p.cold:.2f}",
                cold,
                significant(float(truth[k]), 5),
                f"{p.warm:.2f}",
                warm,
                study.temperature.verdicts[k].value,
            )
        )
    return Grid(
        "cold and warm (Sec. 6)",
        ("parameter", "paper\ncold", "cold", "truth\ncold", "paper\nwarm", "warm", "verdict"),
        tuple(rows),
    )


def following(study: Study) -> Grid:
    """How well the path of ISO 9283 is followed."""
    rows = tuple(
        (
            one.name,
            _milli(one.rms),
            _milli(one.largest),
            _milli(float(one.joints[0])),
            _milli(float(np.sqrt(np.mean(one.joints[1:] ** 2)))),
        )
        for one in study.followed
    )
    return Grid(
        "following the path of ISO 9283 by computed torque",
        (
            "fed forward",
            "end-effector\nRMS [mm]",
            "end-effector\nmax [mm]",
            "rail\nRMS [mm]",
            "joints\nRMS [mrad]",
        ),
        rows,
    )


def coverage(study: Study) -> tuple[str, ...]:
    """How often intervals hold the truth where nothing but noise disturbs, for each filter."""
    return tuple(
        f"where noise and encoders alone disturb, {found.inside} of {found.of} estimates "
        f"({100 * found.share:.1f} %) lie within their 95 % intervals with {found.filter}"
        for found in study.coverage
    )


def errors(judged: Judged, recording: int) -> list[float]:
    """Average errors of all axes [% of the largest torque] (Eq. 37).

    Args:
        judged: An estimate.
        recording: 0 for identification, 1 for verification.
    """
    return [float(x) for x in judged.validation.errors[recording].mean_percent]


def moving_errors(study: Study, judged: Judged, recording: int) -> list[float]:
    """Average errors of all axes over the rows at which they do not rest [% of the largest torque].

    Args:
        study: What was found.
        judged: An estimate.
        recording: 0 for identification, 1 for verification.
    """
    found, moving = judged.validation.errors[recording], study.moving(recording)
    sizes = np.where(moving, np.abs(np.asarray(found.errors)), 0.0).sum(axis=0)
    mean = sizes / np.maximum(moving.sum(axis=0), 1)
    return [float(x) for x in 100.0 * mean / np.asarray(found.max_forces)]


def estimate(fit: Fit, k: int) -> str:
    """An estimate with its standard deviation.

    Args:
        fit: With the estimate.
        k: Its index.
    """
    return " ± ".join(with_deviation(float(fit.parameters[k]), float(fit.standard_deviations[k])))


def keeps(study: Study) -> bool:
    """Whether every axis stays below what the paper says, on identification and verification."""
    return max(max(errors(study.weighted, k)) for k in (0, 1)) < ASKED


def _definite(judged: Judged) -> str:
    found = judged.validation.definiteness
    if found.positive_definite:
        return "positive definite"
    return f"not positive definite in {100 * found.indefinite:.0f} % of the poses"


def _lengths(study: Study) -> str:
    return ", ".join(f"{name} = {study.base.lengths[name]:g}" for name in ("l2x", "l3z"))


def _micro(seconds: float) -> str:
    return significant(1e6 * seconds)


def _milli(value: float) -> str:
    return significant(1e3 * value, 3)
