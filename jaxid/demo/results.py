"""Results of the demo beside the paper's numbers: tables, a page, and a record for programs."""

from pathlib import Path
from typing import Any

import numpy as np

import jaxid as jid
from jaxid.io import atomic_folder
from jaxid.report.excitation import side_by_side_table
from jaxid.report.identification import parameter_table
from jaxid.report.page import Section, folded, picture, render_page
from jaxid.report.result_files import write_json
from jaxid.report.result_records import SCHEMAS
from jaxid.result_table import (
    MISSING,
    Column,
    Remark,
    Status,
    Table,
    significant,
    versions,
    with_deviation,
)
from jaxid.simulation.tx90l import COLD, WARM

from . import study as settings
from .study import Study

SHOWN = (0, 2, 4, 6)
"""Axes 1, 5 and 7 of the paper's Figs. 6, 7 and 9, and the shoulder, which holds the arm."""
POINTS = 800
"""Samples of a line in a figure."""


def write_study(folder: Path, study: Study) -> list[Path]:
    """Write `report.html` and `demo.json`, both or none; return the files."""
    page = demo_page(study)
    with atomic_folder(folder) as staging:
        (staging / "report.html").write_text(page, encoding="utf-8")
        write_json(staging / "demo.json", _record(study))
    return [folder / "report.html", folder / "demo.json"]


def tables(study: Study) -> list[Table]:
    """Return all tables of the demo."""
    return [
        paper_table(study),
        *([side_by_side_table(study.plans)] if study.plans else []),
        error_table(study, 0),
        error_table(study, 1),
        study.temperature.group_summary(),
    ]


def remarks(study: Study) -> list[Remark]:
    """Return the findings of the paper, as far as they come out here."""
    worst, true = (
        [max(m.mean_errors(k)) for k in (0, 1)] for m in (study.weighted, study.true)
    )
    plain, weighted = (m.mean_errors(0)[-1] for m in (study.unweighted, study.weighted))
    return [
        Remark(
            "The identified model predicts the torques of every axis to "
            f"{worst[0]:.2g} % of the "
            f"largest torque, and to {worst[1]:.2g} % on an unseen path.",
            Status.GOOD if max(worst) < 1.0 else Status.DOUBTFUL,
            "Mean error of the worst axis; below 1 % in the paper. The true "
            "parameters leave "
            f"{true[0]:.2g} % and {true[1]:.2g} %.",
        ),
        Remark(
            f"Without weights the last axis errs by {plain:.2g} %, with weights by "
            f"{weighted:.2g} "
            "% of its largest torque.",
            Status.GOOD if weighted < plain else Status.BAD,
        ),
    ]


def paper_table(study: Study) -> Table:
    """Return the statements of the paper beside the results of the demo."""
    base = study.base
    speed, acceleration = study.tip_maxima
    worst = [significant(max(study.weighted.mean_errors(k)), 2) for k in (0, 1)]
    definite = [str(m.validation.definiteness) for m in study.models]
    moving = significant(max(study.moving_errors(study.weighted, 1)), 2)
    true = significant(max(study.true.mean_errors(1)), 2)
    lengths = ", ".join(f"{name} = {base.lengths[name]:g}" for name in ("l2x", "l3z"))
    rows = [
        ("parameters, all of them", "70", str(base.model.size)),
        ("base parameters", "44", str(base.size)),
        ("p_B(1) (Eq. 24)", "m1 + m2 + m3 - m4 rc4z / l3z + I1", base.expressions[0]),
        (
            "p_B(2) (Eq. 24)",
            "m2 rc2x + l2x m3 - l2x m4 rc4z / l3z",
            base.expressions[1],
        ),
        ("lengths in it [m]", "l2x, l3z", lengths),
        ("speed of the end-effector, up to [m/s]", "2.7", significant(speed)),
        (
            "acceleration of the end-effector, up to [m/s²]",
            "11.3",
            significant(acceleration),
        ),
        ("mean error, worst axis, identification [%]", "below 1", worst[0]),
        ("mean error, worst axis, verification [%]", "below 1", worst[1]),
        ("the same while the axis moves [%]", MISSING, moving),
        ("verification, by the true parameters [%]", MISSING, true),
        ("mass matrix without weights", "not positive definite", definite[0]),
        ("mass matrix with weights", "positive definite", definite[1]),
        ("mass matrix, consistent bodies", "not done", definite[2]),
    ]
    for k in COLD:
        for state, paper, fit in (
            ("cold", COLD, study.weighted.fit),
            ("warm", WARM, study.warm),
        ):
            own = (fit.parameters[k - 1], fit.standard_deviations[k - 1])
            name = f"p_B({k}), {state} [{base.units[k - 1]}]"
            rows.append(
                (name, f"{paper[k]:.2f}", " ± ".join(with_deviation(*map(float, own))))
            )
    title = f"the paper, and the results on the virtual {base.model.robot.name}"
    names = ("quantity", "paper", "here")
    return Table(title, *map(Column, names, zip(*rows, strict=True)))


def error_table(study: Study, recording: int) -> Table:
    """Return the mean errors of all axes on identification (0) or verification (1) (Fig. 10)."""

    def column(name: str, errors: list[float]) -> Column:
        return Column(name, [*errors, max(errors)], "%", lambda x: significant(x, 2))

    names = study.base.model.robot.joint_names
    role = ("identification", "verification")[recording]
    return Table(
        f"mean error on {role}, relative to the largest torque (Fig. 10)",
        Column("axis", [*names, "worst"]),
        *(
            column(m.name.replace(" ", "\n"), m.mean_errors(recording))
            for m in study.models
        ),
        column("weighted,\nmoving", study.moving_errors(study.weighted, recording)),
        rules=[len(names)],
    )


def demo_page(study: Study) -> str:
    """Return the page of the demo as HTML."""
    headline, *findings = remarks(study)
    notes = (
        "six base parameters, cold and warm, are the paper's",
        *study.base.model.robot.notes,
        "assumed: the other parameters of bodies, rotors and friction, and all "
        "disturbances",
    )
    warming = (
        "Inertial parameters stay, friction falls as the lubricant warms. A parameter "
        "has changed "
        "if its difference is more than chance."
    )
    every, changes = (
        "All base parameters, cold and warm",
        jid.plot.comparison(study.temperature),
    )
    used = ", ".join(f"{name} {number}" for name, number in versions().items())
    return render_page(
        "The paper, end to end",
        [
            ("Results", [headline, findings, paper_table(study)]),
            _excitation(study),
            _identification(study),
            _verification(study),
            (
                "Cold and warm",
                [warming, study.temperature.group_summary(), folded(every, changes)],
            ),
            (
                "The robot, and assumptions",
                [[Remark(n[0].upper() + n[1:]) for n in notes]],
            ),
        ],
        "A persistent method for parameter identification of a seven-axes "
        "manipulator, repeated "
        "on a virtual Stäubli TX90L on its rail, with the paper's numbers beside the "
        "results.",
        f"`jaxid demo --seed {study.seed}`; {used}",
    )


def _excitation(study: Study) -> Section:
    base, series = study.base, study.played.inner
    robot, (speed, acceleration) = base.model.robot, study.tip_maxima
    times = np.linspace(0.0, float(series.duration), POINTS)
    motion = series.motion(times)
    return "Base parameters, and the motion that excites them", [
        f"Of {base.model.size} columns the QR decomposition without pivoting leaves "
        f"{base.size}; "
        "the first two are those of Eq. 24.",
        folded(
            f"All {base.size} base parameters, weighted",
            parameter_table(study.weighted.fit),
        ),
        f"The motion is a Fourier series of {settings.HARMONICS} harmonics at "
        f"{settings.OMEGA:g} "
        "rad/s within all limits and clear of collisions. As in the paper, it has the "
        "least "
        "condition number; the D-optimal one beside it makes the parameters most "
        "certain.",
        *([side_by_side_table(study.plans)] if study.plans else []),
        picture(
            _speed_scene(robot, times, motion),
            "Fig. 3: path of the end-effector along the designed motion, up to "
            f"{speed:.3g} m/s and {acceleration:.3g} m/s² (in the paper 2.7 m/s and "
            "11.3 m/s²).",
        ),
        picture(
            jid.plot.joints(robot, robot.limits, times, motion),
            "Fig. 4: one period of it.",
        ),
    ]


def _identification(study: Study) -> Section:
    robot, observations = study.base.model.robot, study.observations[0]
    begin, end = (float(t) for t in study.played.window)
    time = np.asarray(observations.time)
    shown = np.flatnonzero((time >= begin) & (time <= end))[
        :: max(1, len(time) // (2 * POINTS))
    ]
    desired, filtered = study.played.motion(time[shown]), observations.motion[shown]
    plain, weighted = (
        m.validation.errors[0] for m in (study.unweighted, study.weighted)
    )
    return "Identification with and without weights", [
        "Cold and warm, the servo follows the motion at 1000 Hz. Logs hold angles of "
        "17-bit "
        "encoders and torques with 1 % of noise, ripple, stiction and Stribeck "
        "friction. "
        f"Filter (Eq. 25): {observations.filter}; {observations.rows} rows of each "
        "joint.",
        picture(
            jid.plot.filtered(robot, time[shown], desired, filtered, 2),
            "Fig. 5: desired velocity and acceleration, and those of the filtered "
            "angles.",
        ),
        picture(
            jid.plot.torques(plain, robot, "identified without weights", SHOWN),
            "Fig. 6: torques of the axes 1, 3, 5 and 7, and their prediction without "
            "weights.",
        ),
        picture(
            jid.plot.torques(weighted, robot, "identified with weights", SHOWN),
            "Fig. 7: the same with weights (Eq. 30).",
        ),
    ]


def _verification(study: Study) -> Section:
    robot, path = study.base.model.robot, study.joint_path
    times = np.linspace(0.0, float(path.duration), 5 * POINTS)
    motion = path.motion(times)
    first, second = study.weighted.validation.errors
    return "Verification on another path", [
        f"The path after ISO 9283 in a cube of {settings.EDGE:g} m, with rests at its "
        "corners, up "
        f"to {settings.SPEED:g} m/s and {settings.ACCELERATION:g} m/s². Of the "
        "redundant joint "
        "angles the nearest to a posture are taken.",
        picture(
            _speed_scene(robot, times, motion), "Fig. 8: path of the end-effector."
        ),
        picture(
            jid.plot.torques(second, robot, "verification", SHOWN),
            "Fig. 9: torques of the axes 1, 3, 5 and 7 on the verification path.",
        ),
        picture(
            jid.plot.errors([first], [second], robot),
            "Fig. 10: mean errors on both paths.",
        ),
        (error_table(study, 0), error_table(study, 1)),
        f"“Moving”: rows of each axis above {settings.AT_REST:g} rad/s or m/s. The "
        "torque of an "
        "axis at rest may be anything up to stiction, which no model of speeds "
        "predicts.",
    ]


def _speed_scene(robot: jid.Robot, times: np.ndarray, motion: jid.Motion) -> Any:
    """Return the robot along a motion, coloured by the speeds of its joints."""
    used = 100.0 * np.abs(np.asarray(motion.qd)) / np.asarray(robot.limits.velocity)
    label = "speed [% of the limit]"
    return jid.plot.poses(robot, motion.q, time=times, values=used, label=label)


def _record(study: Study) -> dict[str, Any]:
    """Return the results of the demo for `demo.json`, in rad, m, s, N and N m."""
    base, fits = study.base, (study.weighted.fit, study.warm)
    speed, acceleration = study.tip_maxima
    criteria = [{c.name: c.after for c in plan.criteria} for plan in study.plans]
    return {
        "schema": SCHEMAS["demo.json"],
        "versions": versions(),
        "seed": study.seed,
        "base_parameters": {
            "count": base.size,
            "names": base.names,
            "truth": study.truth,
        },
        "excitation": {
            "designs": [
                {"criterion": plan.criterion.name, "criteria": own}
                for plan, own in zip(study.plans, criteria, strict=True)
            ],
            "tip_speed": speed,
            "tip_acceleration": acceleration,
        },
        "estimates": {
            model.name: {
                "parameters": model.fit.parameters,
                "standard_deviations": model.fit.standard_deviations,
                "mean_percent_identification": model.mean_errors(0),
                "mean_percent_verification": model.mean_errors(1),
                "mean_percent_moving": [study.moving_errors(model, k) for k in (0, 1)],
                "indefinite_share": model.validation.definiteness.indefinite,
            }
            for model in study.models
        },
        "temperature": [
            {
                "number": k,
                "paper": [COLD[k], WARM[k]],
                "estimates": [fit.parameters[k - 1] for fit in fits],
            }
            for k in COLD
        ],
    }
