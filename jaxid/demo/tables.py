"""Results of the demo as tables beside the paper's numbers, and as a record for programs."""

from typing import Any, NamedTuple

import numpy as np

import jaxid as jid
from jaxid.demo import study as settings
from jaxid.demo.study import Model, Study
from jaxid.report.result_json import SCHEMAS, plain, versions
from jaxid.table import MISSING, Column, Remark, Status, Table, significant, with_deviation


class Published(NamedTuple):
    """Base parameter whose values the paper gives (Sec. 6).

    Attributes:
        number: Number in the paper, from 1.
        cold: Value right after the start.
        warm: Value at operating temperature.
        unit: Unit of both values.
    """

    number: int
    cold: float
    warm: float
    unit: str


PUBLISHED = (
    Published(1, 273.40, 273.62, "kg"),
    Published(2, 1.68, 1.65, "kg m"),
    Published(27, 248.41, 90.19, "N s/m"),
    Published(28, 41.26, 25.65, "N m s"),
    Published(34, 312.50, 233.00, "N"),
    Published(35, 18.24, 15.07, "N m"),
)


def tables(study: Study) -> list[Table]:
    """Return all tables of the demo."""
    return [
        paper_table(study),
        *([criteria_table(study)] if study.plans else []),
        error_table(study, 0),
        error_table(study, 1),
        temperature_table(study),
        following_table(study),
    ]


def remarks(study: Study) -> list[Remark]:
    """Return the coverage of the intervals, and whether the errors are as small as the paper's."""
    good = errors_are_small(study)
    text = (
        f"The mean error of every axis is {'below' if good else 'not below'} 1 % of its largest "
        "torque, on identification and verification."
    )
    return [
        *coverage_remarks(study),
        *([Remark(study.timing)] if isinstance(study.timing, str) else []),
        Remark(text, Status.GOOD if good else Status.DOUBTFUL),
    ]


def coverage_remarks(study: Study) -> list[Remark]:
    """Return the coverage of intervals where nothing but noise disturbs, for each filter."""
    return [
        Remark(
            f"With noise and encoders as the only disturbance, {c.inside} of {c.total} estimates "
            f"({100 * c.inside / c.total:.1f} %) lie within their 95 % intervals with {c.filter}."
        )
        for c in study.coverage
    ]


def errors_are_small(study: Study) -> bool:
    """Return whether every axis has a mean error below 1 %, as the paper says."""
    return max(max(study.weighted.mean_errors(k)) for k in (0, 1)) < 1.0


def paper_table(study: Study) -> Table:
    """Return the statements of the paper beside the results of the demo."""
    base, timed = study.base, study.timing
    speed, acceleration = study.tip_maxima
    worst = [significant(max(study.weighted.mean_errors(k)), 2) for k in (0, 1)]
    moving = max(study.moving_errors(study.weighted, 1))
    lengths = ", ".join(f"{name} = {base.lengths[name]:g}" for name in ("l2x", "l3z"))
    rows = [
        ("parameters, all of them", "70", str(base.model.size)),
        ("base parameters", "44", str(base.size)),
        ("p_B(1) (Eq. 24)", "m1 + m2 + m3 - m4 rc4z / l3z + I1", base.expressions[0]),
        ("p_B(2) (Eq. 24)", "m2 rc2x + l2x m3 - l2x m4 rc4z / l3z", base.expressions[1]),
        ("lengths in it [m]", "l2x, l3z", lengths),
        ("speed of the end-effector, up to [m/s]", "2.7", significant(speed)),
        ("acceleration of the end-effector, up to [m/s²]", "11.3", significant(acceleration)),
        ("mean error, worst axis, identification [%]", "below 1", worst[0]),
        ("mean error, worst axis, verification [%]", "below 1", worst[1]),
        ("the same while the axis moves [%]", MISSING, significant(moving, 2)),
        (
            "verification, by the true parameters [%]",
            MISSING,
            significant(max(study.true.mean_errors(1)), 2),
        ),
        ("mass matrix without weights", "not positive definite", _definite(study.unweighted)),
        ("mass matrix with weights", "positive definite", _definite(study.weighted)),
        ("mass matrix, consistent bodies", "not done", _definite(study.consistent)),
    ]
    for p in PUBLISHED:
        for name, value, fit in (
            ("cold", p.cold, study.weighted.fit),
            ("warm", p.warm, study.warm),
        ):
            label = f"p_B({p.number}), {name} [{p.unit}]"
            rows.append((label, f"{value:.2f}", _estimate(fit, p.number - 1)))
    if not isinstance(timed, str):
        rows += [
            ("feed-forward, Eq. 39 as printed [µs]", "11.928", significant(1e6 * timed.literal)),
            ("feed-forward, Eq. 38 [µs]", "15.243", significant(1e6 * timed.full)),
            ("Eq. 39 as printed over Eq. 38", "0.78", significant(timed.ratio, 2)),
            ("feed-forward, Eq. 39 factored [µs]", MISSING, significant(1e6 * timed.factored)),
            ("computed by", "PC, 2.16 GHz", timed.where),
        ]
    title = f"the paper, and the results on the virtual {base.model.robot.name}"
    return _texts(title, ("quantity", "paper", "here"), rows)


def criteria_table(study: Study) -> Table:
    """Return all criteria of both designs and of a random motion."""
    plans = study.plans
    rows = zip(*(plan.criteria for plan in plans), strict=True)
    numbers = [[float(row[0].before), *(float(c.after) for c in row)] for row in rows]
    numbers.append([1.0, *(plan.mean_gain for plan in plans)])
    random, *designed = zip(*numbers, strict=True)
    names = [c.name for c in plans[0].criteria]
    period = 2 * np.pi / settings.OMEGA
    return Table(
        f"motions to identify with: {settings.SAMPLES} samples of a period of {period:.3f} s",
        Column("criterion (small is good)", [*names, "deviations, times smaller than random"]),
        Column("random", random),
        *(Column(p.criterion.name, values) for p, values in zip(plans, designed, strict=True)),
        remarks=[
            Remark(
                f"The motion by the {plan.criterion.name} keeps all limits without collision."
                if plan.feasible
                else f"The motion by the {plan.criterion.name} does not keep all limits.",
                Status.GOOD if plan.feasible else Status.BAD,
            )
            for plan in plans
        ],
    )


def error_table(study: Study, recording: int) -> Table:
    """Return the mean errors of all axes in percent of the largest torque (Fig. 10).

    Args:
        study: Results of the demo.
        recording: 0 for identification, 1 for verification.
    """

    def column(name: str, errors: list[float]) -> Column:
        return Column(name, [*errors, max(errors)], "%", lambda x: significant(x, 2))

    role = ("identification", "verification")[recording]
    names = study.base.model.robot.joint_names
    return Table(
        f"mean error on {role}, relative to the largest torque (Fig. 10)",
        Column("axis", [*names, "worst"]),
        *(column(m.name.replace(" ", "\n"), m.mean_errors(recording)) for m in study.models),
        column("weighted,\nmoving", study.moving_errors(study.weighted, recording)),
        rules=[len(names)],
    )


def temperature_table(study: Study) -> Table:
    """Return the cold and warm parameters that the paper gives, beside truth and estimates."""
    indices = [p.number - 1 for p in PUBLISHED]
    expressions = study.base.expressions
    names = [f"p_B({k + 1}) = {expressions[k]}" for k in indices]
    return Table(
        "cold and warm (Sec. 6)",
        Column("parameter", names),
        Column("unit", [p.unit for p in PUBLISHED]),
        Column("paper\ncold", [p.cold for p in PUBLISHED], format=lambda x: f"{x:.2f}"),
        Column("cold", [_estimate(study.weighted.fit, k) for k in indices]),
        Column("truth\ncold", study.truth[indices], format=lambda x: significant(x, 5)),
        Column("paper\nwarm", [p.warm for p in PUBLISHED], format=lambda x: f"{x:.2f}"),
        Column("warm", [_estimate(study.warm, k) for k in indices]),
        Column("verdict", [study.temperature.verdicts[k].value for k in indices]),
    )


def following_table(study: Study) -> Table:
    """Return how well the path of ISO 9283 is followed with each model."""
    runs = study.followed
    joints = [np.sqrt(np.mean(run.joint_rms[1:] ** 2)) for run in runs]
    return Table(
        "following the path of ISO 9283 by computed torque",
        Column("fed forward", [run.name for run in runs]),
        Column("end-effector\nRMS", [1e3 * run.rms for run in runs], "mm"),
        Column("end-effector\nmax", [1e3 * float(run.distance.max()) for run in runs], "mm"),
        Column("rail\nRMS", [1e3 * float(run.joint_rms[0]) for run in runs], "mm"),
        Column("joints\nRMS", [1e3 * float(x) for x in joints], "mrad"),
    )


def _texts(title: str, names: tuple[str, ...], rows: list[tuple[str, ...]]) -> Table:
    columns = zip(names, zip(*rows, strict=True), strict=True)
    return Table(title, *(Column(name, values) for name, values in columns))


def _estimate(fit: jid.Fit, k: int) -> str:
    return " ± ".join(with_deviation(float(fit.parameters[k]), float(fit.standard_deviations[k])))


def _definite(model: Model) -> str:
    found = model.validation.definiteness
    if found.positive_definite:
        return "positive definite"
    return f"not positive definite in {100 * found.indefinite:.0f} % of the poses"


def record(study: Study) -> dict[str, Any]:
    """Return all results of the demo for `demo.json`, in rad, m, s, N and N m."""
    base, robot = study.base, study.base.model.robot
    series: Any = study.played.inner
    fits, timed = (study.weighted.fit, study.warm), study.timing
    speed, acceleration = study.tip_maxima
    return plain(
        {
            "schema": SCHEMAS["demo.json"],
            "versions": versions(),
            "seed": study.seed,
            "robot": {
                "name": robot.name,
                "joints": robot.joint_names,
                "largest_forces": np.asarray(robot.max_forces),
                "assumed": (*robot.limits.assumed, *robot.notes),
            },
            "settings": {
                "harmonics": settings.HARMONICS,
                "omega": settings.OMEGA,
                "samples": settings.SAMPLES,
                "sample_time": settings.SAMPLE_TIME,
                "step": settings.STEP,
                "at_rest": settings.AT_REST,
                "filter": str(study.observations[0].filter),
                "path": {
                    "cube_centre": settings.CUBE,
                    "cube_edge": settings.EDGE,
                    "speed": settings.SPEED,
                    "acceleration": settings.ACCELERATION,
                    "length": study.path.length,
                    "duration": study.path.duration,
                },
            },
            "base_parameters": {
                "standard": base.model.size,
                "count": base.size,
                "names": base.names,
                "expressions": base.expressions,
                "units": base.units,
                "lengths": base.lengths,
                "truth": study.truth,
            },
            "excitation": {
                "designs": [
                    {
                        "criterion": plan.criterion.name,
                        "criteria": {c.name: c.after for c in plan.criteria},
                        "random": {c.name: c.before for c in plan.criteria},
                        "gain": plan.mean_gain,
                        "feasible": plan.feasible,
                        "numbers": np.asarray(plan.trajectory.coefficients),
                    }
                    for plan in study.plans
                ],
                "coefficients": np.asarray(series.coefficients),
                "tip_speed": speed,
                "tip_acceleration": acceleration,
                "window": [float(t) for t in study.played.window],
            },
            "estimates": {model.name: _model_record(model, study) for model in study.models},
            "below_one_percent": errors_are_small(study),
            "temperature": [
                {
                    "number": p.number,
                    "name": base.names[p.number - 1],
                    "expression": base.expressions[p.number - 1],
                    "unit": p.unit,
                    "paper": [p.cold, p.warm],
                    "estimates": [float(f.parameters[p.number - 1]) for f in fits],
                    "standard_deviations": [f.standard_deviations[p.number - 1] for f in fits],
                    "verdict": study.temperature.verdicts[p.number - 1].value,
                }
                for p in PUBLISHED
            ],
            "coverage": [
                {"filter": c.filter, "inside": c.inside, "of": c.total} for c in study.coverage
            ],
            "following": [
                {
                    "fed_forward": run.name,
                    "tip_rms": run.rms,
                    "tip_largest": run.distance.max(),
                    "joint_rms": run.joint_rms,
                    "saturated": np.asarray(run.run.saturated),
                }
                for run in study.followed
            ],
            "feed_forward": timed if isinstance(timed, str) else timed._asdict(),
        }
    )


def _model_record(model: Model, study: Study) -> dict[str, Any]:
    first, second = model.validation.errors
    definiteness = model.validation.definiteness
    return {
        "parameters": np.asarray(model.fit.parameters),
        "standard_deviations": model.fit.standard_deviations,
        "mean_percent_identification": model.mean_errors(0),
        "mean_percent_verification": model.mean_errors(1),
        "mean_percent_moving": [study.moving_errors(model, k) for k in (0, 1)],
        "rms_percent_identification": first.rms_percent,
        "rms_percent_verification": second.rms_percent,
        "smallest_eigenvalue": definiteness.smallest,
        "indefinite_share": definiteness.indefinite,
    }
