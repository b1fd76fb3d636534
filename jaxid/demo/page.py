"""The demo as a page: the paper's figures and tables, with a short text to each."""

from pathlib import Path

import numpy as np

import jaxid as jid
from jaxid.demo.study import ACCELERATION, AT_REST, EDGE, HARMONICS, OMEGA, SPEED, Study
from jaxid.demo.tables import (
    coverage_remarks,
    criteria_table,
    error_table,
    errors_are_small,
    following_table,
    paper_table,
    record,
    temperature_table,
)
from jaxid.io import atomic_folder
from jaxid.report.identification import page_parameter_table
from jaxid.report.page import Section, block, facts, picture, render_page
from jaxid.report.result_files import write_json
from jaxid.report.result_json import versions
from jaxid.table import Remark, Status

SHOWN = (0, 2, 4, 6)
"""Axes 1, 5 and 7 of the paper's Figs. 6, 7 and 9, and the shoulder, which holds the arm."""
POINTS = 800
"""Samples of a line in a figure."""


def write_study(folder: Path, study: Study) -> list[Path]:
    """Write `report.html` and `demo.json`, both or none.

    Args:
        folder: Folder of the files.
        study: Results of the demo.
    """
    page = demo_page(study)
    with atomic_folder(folder) as staging:
        (staging / "report.html").write_text(page, encoding="utf-8")
        write_json(staging / "demo.json", record(study))
    return [folder / "report.html", folder / "demo.json"]


def demo_page(study: Study) -> str:
    """Return the page of the demo as HTML."""
    used = ", ".join(f"{name} {number}" for name, number in versions().items())
    return render_page(
        "The paper, end to end",
        [
            Section("Results", _verdict(study)),
            Section("Base parameters", _parameters(study)),
            Section("The motion that excites them", _excitation(study)),
            Section("Measurement and filter", _measurement(study)),
            Section("Identification with and without weights", _identification(study)),
            Section("Verification on another path", _verification(study)),
            Section("Cold and warm", _temperature(study)),
            Section("Application: following a path", _following(study)),
            Section("The robot, and assumptions", _assumptions(study)),
        ],
        "A persistent method for parameter identification of a seven-axes manipulator, repeated "
        "on a virtual Stäubli TX90L on its rail, with the paper's numbers beside the results.",
        f"`jaxid demo --seed {study.seed}`; {used}",
    )


def _verdict(study: Study) -> list[str]:
    worst = [max(study.weighted.mean_errors(k)) for k in (0, 1)]
    true = [max(study.true.mean_errors(k)) for k in (0, 1)]
    moving = [max(study.moving_errors(study.weighted, k)) for k in (0, 1)]
    plain, weighted = (m.mean_errors(0)[-1] for m in (study.unweighted, study.weighted))
    definiteness = study.consistent.validation.definiteness
    definite = definiteness.positive_definite
    none, cad, identified = (1e3 * run.rms for run in study.followed)
    headline = Remark(
        f"The identified model predicts the torques of every axis to {worst[0]:.2g} % of the "
        f"largest torque on the motion of the identification, and to {worst[1]:.2g} % on an unseen "
        "path.",
        Status.GOOD if errors_are_small(study) else Status.DOUBTFUL,
        "Mean error of the worst axis; the paper states below 1 %.",
    )
    remarks = [
        Remark(
            f"Without weights the last axis errs by {plain:.2g} %, with weights by {weighted:.2g} "
            "% of its largest torque.",
            Status.GOOD if weighted < plain else Status.BAD,
        ),
        Remark(
            f"The mass matrix of the consistent estimate is {'' if definite else 'not '}positive "
            f"definite in all {definiteness.poses} poses.",
            Status.GOOD if definite else Status.BAD,
        ),
        Remark(
            "With the identified model fed forward the end-effector keeps its path to "
            f"{identified:.2g} mm (RMS), with CAD values to {cad:.2g} mm, without a model to "
            f"{none:.2g} mm.",
            Status.GOOD if identified < cad < none else Status.DOUBTFUL,
        ),
        Remark(
            f"The true parameters themselves would err by {true[0]:.2g} % and {true[1]:.2g} %: "
            "stiction, Stribeck friction, ripple and noise are not in the model. Where axes move, "
            f"the estimates err by {moving[0]:.2g} % and {moving[1]:.2g} %; at rest stiction holds "
            "any torque."
        ),
        *coverage_remarks(study),
        *([Remark(study.timing)] if isinstance(study.timing, str) else []),
    ]
    return [
        block("headline", headline),
        block("remarks", remarks),
        block("table", paper_table(study)),
    ]


def _parameters(study: Study) -> list[str]:
    size, count = study.base.model.size, study.base.size
    text = (
        "Seven bodies with seven parameters each, viscous and Coulomb friction and rotors make "
        f"{size} columns. The QR decomposition without pivoting leaves {count} of them; the first "
        "two are those that the paper prints in Eq. 24."
    )
    table = block("table", page_parameter_table(study.weighted.fit))
    summary = f"All {count} base parameters, as estimated with weights, cold"
    return [block("paragraph", text), block("folded", summary, table)]


def _excitation(study: Study) -> list[str]:
    robot, series = study.base.model.robot, study.played.inner
    speed, acceleration = study.tip_maxima
    times = np.linspace(0.0, float(series.duration), POINTS)
    motion = _as_arrays(series.motion(times))
    text = (
        f"A Fourier series of {HARMONICS} harmonics at {OMEGA:g} rad/s within all limits and "
        "clear of collisions. The paper minimises the condition number of the unweighted "
        "information matrix; that motion is run here. The D-optimal one beside it makes the "
        "parameters most certain."
    )
    return [
        block("paragraph", text),
        *([block("table", criteria_table(study))] if study.plans else []),
        picture(
            jid.plot.path(robot, motion, times),
            "Fig. 3: path of the end-effector along the designed motion. The paper states up to "
            f"2.7 m/s and 11.3 m/s²; here {speed:.3g} m/s and {acceleration:.3g} m/s².",
        ),
        picture(
            jid.plot.joints(robot, robot.limits, times, motion),
            "Fig. 4: one period of the designed motion.",
        ),
    ]


def _measurement(study: Study) -> list[str]:
    robot, observations = study.base.model.robot, study.observations[0]
    begin, end = (float(t) for t in study.played.window)
    time = np.asarray(observations.time)
    shown = np.flatnonzero((time >= begin) & (time <= end))[:: max(1, len(time) // (2 * POINTS))]
    desired = _as_arrays(study.played.motion(time[shown]))
    text = (
        "The virtual robot follows the motion by its servo at 1000 Hz: cold, and once more when "
        "it is warm. Logs hold the angles of 17-bit motor encoders and motor torques with 1 % of "
        "noise, disturbed by ripple, stiction and Stribeck friction that the model does not have."
    )
    rows = [
        ("filter (Eq. 25)", observations.filter),
        ("rows of each joint", observations.rows),
        ("time at a torque limit, at most", f"{100 * study.runs[0].saturated.max():.2g} %"),
    ]
    return [
        block("paragraph", text),
        facts(rows),
        picture(
            jid.plot.filtered(robot, time[shown], desired, observations.motion[shown], 2),
            "Fig. 5: desired velocity and acceleration, and those that the filter makes of the "
            "measured angles.",
        ),
    ]


def _identification(study: Study) -> list[str]:
    robot = study.base.model.robot
    plain, weighted = (m.validation.errors[0] for m in (study.unweighted, study.weighted))
    return [
        picture(
            jid.plot.torques(plain, robot, "identified without weights", SHOWN),
            "Fig. 6: torques of the axes 1, 3, 5 and 7, and their prediction by a model that was "
            "identified without weights.",
        ),
        picture(
            jid.plot.torques(weighted, robot, "identified with weights", SHOWN),
            "Fig. 7: the same with weights (Eq. 30).",
        ),
    ]


def _verification(study: Study) -> list[str]:
    robot, path = study.base.model.robot, study.joint_path
    times = np.linspace(0.0, float(path.duration), 5 * POINTS)
    motion = _as_arrays(path.motion(times))
    first, second = study.weighted.validation.errors
    tables = (block("table", error_table(study, k)) for k in (0, 1))
    text = (
        "The path after ISO 9283: straight lines, a rectangle and two circles on the plane through "
        f"two opposite edges of a cube of {EDGE:g} m. Where pieces meet the end-effector is at "
        f"rest; speed up to {SPEED:g} m/s, acceleration up to {ACCELERATION:g} m/s². The seven "
        "joints are redundant: of all solutions the nearest to a posture are taken."
    )
    moving = (
        f"“Moving”: rows of each axis above {AT_REST:g} rad/s or m/s, "
        f"{100 * np.mean(study.moving(1)):.0f} % of the verification. The torque of an axis at "
        "rest may be anything up to stiction, which no model of speeds predicts, and this path "
        "rests at every corner."
    )
    return [
        block("paragraph", text),
        picture(jid.plot.path(robot, motion, times), "Fig. 8: path of the end-effector."),
        picture(
            jid.plot.poses(robot, motion.q[::5], jid.robots.tx90l_on_rail_collision()),
            "The robot with its capsules along the path.",
        ),
        picture(
            jid.plot.torques(second, robot, "verification", SHOWN),
            "Fig. 9: torques of the axes 1, 3, 5 and 7 on the verification path.",
        ),
        picture(
            jid.plot.errors([first], [second], robot),
            "Fig. 10: mean errors on identification and verification.",
        ),
        block("abreast", *tables),
        block("paragraph", moving),
    ]


def _temperature(study: Study) -> list[str]:
    text = (
        "Two identifications of the same motion. Inertial parameters stay, friction falls as the "
        "lubricant warms; a parameter has changed if its difference is more than chance."
    )
    figure = picture(jid.plot.comparison(study.temperature))
    return [
        block("paragraph", text),
        block("table", temperature_table(study)),
        block("folded", "All base parameters, cold and warm", figure),
    ]


def _following(study: Study) -> list[str]:
    step = max(1, len(study.followed[0].distance) // (2 * POINTS))
    runs = [(r.name, np.asarray(r.run.time)[::step], r.distance[::step]) for r in study.followed]
    text = (
        "The verification path once more, with the same servo, and three torques fed forward: "
        "none, those of a CAD model whose bodies are 10 to 18 % off and that has no friction, and "
        "those of the identified model."
    )
    return [
        block("paragraph", text),
        block("table", following_table(study)),
        picture(jid.plot.distances(runs), "Distance of the end-effector from its path."),
    ]


def _assumptions(study: Study) -> list[str]:
    text = (
        "Six base parameters, cold and warm, are the paper's. Everything that it does not publish "
        "is assumed."
    )
    notes = (
        *study.base.model.robot.notes,
        "assumed: the other parameters of bodies, rotors and friction, and all disturbances.",
    )
    remarks = [Remark(note[0].upper() + note[1:]) for note in notes]
    return [block("paragraph", text), block("remarks", remarks)]


def _as_arrays(motion: jid.Motion) -> jid.Motion:
    return jid.Motion(*(np.asarray(x) for x in (motion.q, motion.qd, motion.qdd)))
