"""Results of the demo beside the paper's: tables, a page, and a record for programs."""

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np

import jaxid as jid
from jaxid.io import atomic_folder
from jaxid.report.identification_page import parameter_table
from jaxid.report.motion_figures import speed_figure
from jaxid.report.page import Section, folded, picture, render_page
from jaxid.report.result_files import write_json
from jaxid.report.result_records import header
from jaxid.result_table import (
    Column,
    Remark,
    Status,
    Summarised,
    Table,
    significant,
    versions,
    with_deviation,
)
from jaxid.simulation.tx90l import COLD, WARM

from . import study as settings
from .study import Study

FIGURE_AXES = (0, 2, 4, 6)
"""Axes 1, 5 and 7 of the paper's Figs. 6, 7 and 9, and the shoulder."""
MAX_EXCESS = 1.1
"""Error on the unseen path over that of the true parameters, up to which it is good."""
POINTS = 800
"""Samples of a line in a figure."""


def write_study(folder: Path, study: Study) -> list[Path]:
    """Write `report.html` and `demo.json`, both or none; return the files."""
    page = demo_page(study)
    with atomic_folder(folder) as staging:
        (staging / "report.html").write_text(page, encoding="utf-8")
        write_json(staging / "demo.json", _study_record(study))
    return [folder / "report.html", folder / "demo.json"]


@dataclasses.dataclass(frozen=True, eq=False)
class DemoResult(Summarised):
    """Result of the demo as a terminal shows it."""

    study: Study

    @property
    def verdict(self) -> Remark:
        """How well the model predicts torques, in one sentence."""
        return dataclasses.replace(remarks(self.study)[0], detail="")

    def overview(self) -> list[Table]:
        """Return the findings, and the errors on the unseen path."""
        findings = Table("", remarks=remarks(self.study))
        return [findings, error_table(self.study, 1)]

    def tables(self) -> list[Table]:
        """Return all tables, then the findings."""
        study = self.study
        designs = [] if study.plan is None else study.plan.tables()[:1]
        return [
            paper_table(study),
            *designs,
            error_table(study, 0),
            error_table(study, 1),
            study.temperature.group_summary(),
            Table("", remarks=remarks(study)),
        ]


def remarks(study: Study) -> list[Remark]:
    """Return the findings of the paper, as far as they come out here."""
    identification = max(study.weighted_model.mean_errors(0))
    verification = max(study.weighted_model.mean_errors(1))
    true_verification = max(study.true_model.mean_errors(1))
    error = study.unweighted_model.mean_errors(0)[-1]
    weighted_error = study.weighted_model.mean_errors(0)[-1]
    # Better than the true parameters, which leave the noise, none can be.
    is_good = verification < MAX_EXCESS * true_verification
    return [
        Remark(
            "The identified model predicts the torques of every axis to "
            f"{identification:.2g} % of the largest torque, and to "
            f"{verification:.2g} % on an unseen path.",
            Status.GOOD if is_good else Status.DOUBTFUL,
            "Mean error of the worst axis; below 1 % in the paper. With the true "
            f"parameters: {max(study.true_model.mean_errors(0)):.2g} % and "
            f"{true_verification:.2g} %.",
        ),
        Remark(
            f"The error of the last axis is {error:.2g} % of its largest torque "
            f"without weights, and {weighted_error:.2g} % with weights.",
            Status.GOOD if weighted_error < error else Status.BAD,
        ),
    ]


def paper_table(study: Study) -> Table:
    """Return the statements of the paper beside the results of the demo."""
    base = study.base
    expressions = base.expressions
    speed, acceleration = study.tip_maxima
    definiteness_texts = [str(model.validation.definiteness) for model in study.models]

    rows = [
        ("parameters, all of them", "70", str(base.model.size)),
        ("base parameters", "44", str(base.size)),
        (
            "p_B(1) (Eq. 24), l3z = 0.05 m",
            "m1 + m2 + m3 - m4 rc4z / l3z + I1",
            expressions[0],
        ),
        (
            "p_B(2) (Eq. 24), l2x = l3z",
            "m2 rc2x + l2x m3 - l2x m4 rc4z / l3z",
            expressions[1],
        ),
        ("speed of the end-effector, up to [m/s]", "2.7", significant(speed)),
        (
            "acceleration of the end-effector, up to [m/s²]",
            "11.3",
            significant(acceleration),
        ),
        (
            "mean error, worst axis, identification [%]",
            "below 1",
            significant(max(study.weighted_model.mean_errors(0)), 2),
        ),
        (
            "mean error, worst axis, verification [%]",
            "below 1",
            significant(max(study.weighted_model.mean_errors(1)), 2),
        ),
        ("mass matrix without weights", "not positive definite", definiteness_texts[0]),
        ("mass matrix with weights", "positive definite", definiteness_texts[1]),
        ("mass matrix, consistent bodies", "not done", definiteness_texts[2]),
    ]
    for k in COLD:
        for state, paper, fit in (
            ("cold", COLD, study.weighted_model.fit),
            ("warm", WARM, study.warm_fit),
        ):
            estimate, deviation = with_deviation(
                float(fit.parameters[k - 1]), float(fit.standard_deviations[k - 1])
            )
            name = f"p_B({k}), {state} [{base.units[k - 1]}]"
            rows.append((name, f"{paper[k]:.2f}", f"{estimate} ± {deviation}"))
    quantities, statements, results = zip(*rows, strict=True)
    return Table(
        f"the paper, beside the results on the virtual {base.model.robot.name}",
        Column("quantity", quantities),
        Column("paper", statements),
        Column("here", results),
    )


def error_table(study: Study, recording: int) -> Table:
    """Return the mean errors of all axes on one of the two logs (Fig. 10).

    Log 0 served the identification, log 1 is for verification.
    """

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
        rules=[len(names)],
    )


def demo_page(study: Study) -> str:
    """Return the page of the demo as HTML."""
    headline, *findings = remarks(study)
    notes = (
        "six base parameters, cold and warm, have the values of the paper",
        *study.base.model.robot.notes,
        "assumed: the other parameters of bodies, rotors and friction, and all "
        "disturbances",
    )
    sentences = [Remark(note[0].upper() + note[1:]) for note in notes]
    software = ", ".join(f"{name} {number}" for name, number in versions().items())
    return render_page(
        "The paper, end to end",
        [
            ("Results", [headline, findings, paper_table(study)]),
            _excitation(study),
            _identification(study),
            _verification(study),
            ("Cold and warm", _temperature(study)),
            ("The robot, and assumptions", [sentences]),
        ],
        "A persistent method for parameter identification of a seven-axes "
        "manipulator, repeated on a virtual Stäubli TX90L on its rail, with the "
        "paper's numbers beside the results.",
        f"`jaxid demo --seed {study.seed}`; {software}",
    )


def _temperature(study: Study) -> list[Any]:
    """Return what has changed as the robot became warm."""
    comparison = study.temperature
    return [
        "Inertial parameters do not change; friction falls as the lubricant warms. A "
        "parameter has changed if its difference is statistically significant.",
        comparison.group_summary(),
        folded("All base parameters, cold and warm", jid.plot.comparison(comparison)),
    ]


def _excitation(study: Study) -> Section:
    base = study.base
    robot = base.model.robot
    series = study.played_motion.inner
    times = np.linspace(0.0, float(series.duration), POINTS)
    motion = series.motion(times)
    speed, acceleration = study.tip_maxima
    designs = [] if study.plan is None else study.plan.tables()[:1]
    return "Base parameters, and the motion that excites them", [
        f"The QR decomposition without pivoting keeps {base.size} of "
        f"{base.model.size} columns; the first two are those of Eq. 24.",
        folded(
            f"All {base.size} base parameters, weighted",
            parameter_table(study.weighted_model.fit),
        ),
        f"The motion is a Fourier series of {settings.HARMONICS} harmonics at "
        f"{settings.OMEGA:g} rad/s within all limits and clear of collisions. As in "
        "the paper, it minimises the condition number.",
        *designs,
        picture(
            speed_figure(robot, robot.limits, times, motion),
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
    robot = study.base.model.robot
    log = study.observations[0]
    unweighted_errors = study.unweighted_model.validation.errors[0]
    weighted_errors = study.weighted_model.validation.errors[0]
    return "Identification with and without weights", [
        "The servo follows the motion at 1000 Hz, once cold and once warm. Logs "
        "contain angles from 17-bit encoders and torques with 1 % of noise, ripple, "
        f"stiction and Stribeck friction. Filter (Eq. 25): {log.filter}; {log.rows} "
        "rows of each joint.",
        picture(
            jid.plot.torques(
                unweighted_errors, robot, "identified without weights", FIGURE_AXES
            ),
            "Fig. 6: torques of the axes 1, 3, 5 and 7, and their prediction without "
            "weights.",
        ),
        picture(
            jid.plot.torques(
                weighted_errors, robot, "identified with weights", FIGURE_AXES
            ),
            "Fig. 7: the same with weights (Eq. 30).",
        ),
    ]


def _verification(study: Study) -> Section:
    robot = study.base.model.robot
    path = study.joint_path
    times = np.linspace(0.0, float(path.duration), 5 * POINTS)
    identification, verification = study.weighted_model.validation.errors
    groups = {"identification": [identification], "verification": [verification]}
    return "Verification on another path", [
        f"The path after ISO 9283 in a cube of {settings.EDGE:g} m, with rests at its "
        f"corners, up to {settings.SPEED:g} m/s and {settings.ACCELERATION:g} m/s². "
        "Where several joint angles reach a pose, those nearest to a given posture "
        "are used.",
        picture(
            speed_figure(robot, robot.limits, times, path.motion(times)),
            "Fig. 8: path of the end-effector.",
        ),
        picture(
            jid.plot.torques(verification, robot, "verification", FIGURE_AXES),
            "Fig. 9: torques of the axes 1, 3, 5 and 7 on the verification path.",
        ),
        picture(
            jid.plot.bars(groups, robot),
            "Fig. 10: errors on both paths; the paper's measure is in the tables.",
        ),
        (error_table(study, 0), error_table(study, 1)),
        "At rest, friction can take any value up to stiction. A model in which "
        "friction depends on speed cannot predict it, so even the true parameters "
        "leave errors there.",
    ]


def _study_record(study: Study) -> dict[str, Any]:
    """Return the results of the demo for `demo.json`, in rad, m, s, N and N m."""
    base = study.base
    speed, acceleration = study.tip_maxima
    cold_parameters = study.weighted_model.fit.parameters
    warm_parameters = study.warm_fit.parameters
    return {
        **header("demo.json"),
        "seed": study.seed,
        "base_parameters": base.size,
        "excitation": {
            "tip_speed": speed,
            "tip_acceleration": acceleration,
        },
        "estimates": {
            model.name: {
                "parameters": model.fit.parameters,
                "standard_deviations": model.fit.standard_deviations,
                "mean_percent_identification": model.mean_errors(0),
                "mean_percent_verification": model.mean_errors(1),
                "indefinite_share": model.validation.definiteness.indefinite,
            }
            for model in study.models
        },
        "temperature": [
            {
                "number": k,
                "paper": [COLD[k], WARM[k]],
                "estimates": [cold_parameters[k - 1], warm_parameters[k - 1]],
            }
            for k in COLD
        ],
    }
