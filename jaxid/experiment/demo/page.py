"""The demo as a page: the paper's figures and tables, and what is to be read from them."""

import numpy as np

from jaxid.dynamics.motion import Motion
from jaxid.experiment.demo.study import (
    ACCELERATION,
    AT_REST,
    EDGE,
    FINE,
    HARMONICS,
    OMEGA,
    SAMPLE_TIME,
    SPEED,
    Study,
)
from jaxid.experiment.demo.tables import (
    ASKED,
    Grid,
    average_errors,
    beside_paper,
    coverage,
    criteria,
    errors,
    following,
    keeps,
    moving_errors,
    temperature,
)
from jaxid.measurement.filters import AbstractFilter, PaperFilter
from jaxid.report.bars import error_figure
from jaxid.report.blocks import (
    Abreast,
    AbstractBlock,
    Column,
    Facts,
    Folded,
    Headline,
    Picture,
    Prose,
    Remark,
    Remarks,
    Sheet,
    Tone,
)
from jaxid.report.compared import comparison_figure
from jaxid.report.content import versions
from jaxid.report.following import following_figure
from jaxid.report.motion_figures import filtered_figure, joint_figure
from jaxid.report.page import Page, Section
from jaxid.report.sheets import parameter_sheet
from jaxid.report.space import path_figure, pose_figure
from jaxid.report.torques import torque_figure
from jaxid.robot.library import tx90l_on_rail_collision

SHOWN = (0, 2, 4, 6)
"""Axes 1, 5 and 7 of the paper's Figs. 6, 7 and 9, and the shoulder, which holds the arm."""
FILTERED = 2
"""Joint of Fig. 5: q_3."""
POINTS = 800
"""Samples of a line in a figure."""


def page(study: Study) -> Page:
    """The report.

    Args:
        study: What was found.
    """
    used = ", ".join(f"{name} {number}" for name, number in versions().items())
    return Page(
        title="The paper, end to end",
        lead="A persistent method for parameter identification of a seven-axes manipulator, done "
        "on a virtual Stäubli TX90L on its rail. What the paper printed stands beside what came "
        "out here.",
        sections=(
            Section("What came out", _verdict(study)),
            Section("Base parameters", _parameters(study)),
            Section("The motion that excites them", _excitation(study)),
            Section("Measurement and filter", _measurement(study)),
            Section("Identification with and without weights", _identification(study)),
            Section("Verification on another path", _verification(study)),
            Section("Cold and warm", _temperature(study)),
            Section("What it is for: following a path", _following(study)),
            Section("The robot, and what was assumed", _assumed(study)),
        ),
        footer=f"`jaxid demo --seed {study.seed}`; {used}",
    )


def _sheet(grid: Grid) -> Sheet:
    columns = tuple(Column(head, number=k > 0) for k, head in enumerate(grid.columns))
    return Sheet(columns, grid.rows, grid.title)


def _verdict(study: Study) -> tuple[AbstractBlock, ...]:
    good = keeps(study)
    worst = [max(errors(study.weighted, k)) for k in (0, 1)]
    moving = [moving_errors(study, study.weighted, k) for k in (0, 1)]
    none, cad, identified = study.followed
    timed = (_sentence(study.timing),) if isinstance(study.timing, str) else ()
    definite = study.consistent.validation.definiteness.positive_definite
    wrist = [errors(x, 0)[-1] for x in (study.unweighted, study.weighted)]
    return (
        Headline(
            Remark(
                Tone.GOOD if good else Tone.DOUBTFUL,
                f"The identified model predicts the torques of every axis to {worst[0]:.2g} % of "
                f"the largest torque on the motion of the identification, and to {worst[1]:.2g} % "
                "on a path that it has not seen.",
                f"average error of the worst axis; the paper states below {ASKED:g} %",
            )
        ),
        Remarks(
            (
                Remark(
                    Tone.GOOD if wrist[1] < wrist[0] else Tone.BAD,
                    f"Weights matter: without them the last axis errs by {wrist[0]:.2g} %, with "
                    f"them by {wrist[1]:.2g} % of its largest torque.",
                ),
                Remark(
                    Tone.GOOD if definite else Tone.BAD,
                    "The mass matrix of the consistent estimate is positive definite in all "
                    f"{study.consistent.validation.definiteness.poses} poses."
                    if definite
                    else "The mass matrix of the consistent estimate is not positive definite.",
                ),
                Remark(
                    Tone.GOOD if identified.rms < cad.rms < none.rms else Tone.DOUBTFUL,
                    f"With the identified model fed forward the end-effector keeps its path to "
                    f"{1e3 * identified.rms:.2g} mm (RMS), with CAD values to "
                    f"{1e3 * cad.rms:.2g} mm, without a model to {1e3 * none.rms:.2g} mm.",
                ),
                Remark(
                    Tone.PLAIN,
                    "The true parameters themselves would err by "
                    f"{max(errors(study.true, 0)):.2g} % and {max(errors(study.true, 1)):.2g} %: "
                    "stiction, Stribeck friction, ripple and noise, which the model does not have. "
                    f"Where axes move, the estimates err by {max(moving[0]):.2g} % and "
                    f"{max(moving[1]):.2g} %; at rest stiction holds any torque.",
                ),
                *(Remark(Tone.PLAIN, _sentence(text)) for text in (*coverage(study), *timed)),
            )
        ),
        _sheet(beside_paper(study)),
    )


def _parameters(study: Study) -> tuple[AbstractBlock, ...]:
    base = study.base
    return (
        Prose(
            "Seven bodies with seven parameters each, viscous and Coulomb friction and rotors make "
            f"{base.model.size} columns. The QR decomposition without pivoting leaves {base.size} "
            "of them; the first two are those that the paper prints in Eq. 24."
        ),
        Folded(
            f"All {base.size} base parameters, as estimated with weights, cold",
            (parameter_sheet(study.weighted.fit),),
        ),
    )


def _excitation(study: Study) -> tuple[AbstractBlock, ...]:
    robot, excitation = study.base.model.robot, study.excitation
    series = excitation.played.inner
    times = np.linspace(0.0, float(series.duration), POINTS)
    motion = _plain(series.motion(times))
    designs = (_sheet(criteria(study)),) if excitation.plans else ()
    return (
        Prose(
            f"A Fourier series of {HARMONICS} harmonics at {OMEGA:g} rad/s within all limits and "
            "clear of collisions. The paper minimises the condition number of the unweighted "
            "information matrix; that motion is run here. The D-optimal one beside it is what "
            "makes the parameters most certain."
        ),
        *designs,
        Picture(
            path_figure(robot, motion, times),
            "Fig. 3: path of the end-effector along the designed motion. The paper states up to "
            f"2.7 m/s and 11.3 m/s²; here {excitation.speed:.3g} m/s and "
            f"{excitation.acceleration:.3g} m/s².",
        ),
        Picture(
            joint_figure(robot, robot.limits, times, motion),
            "Fig. 4: one period of the designed motion.",
        ),
    )


def _measurement(study: Study) -> tuple[AbstractBlock, ...]:
    robot, run = study.base.model.robot, study.measured.cold
    observations = study.measured.filtered[0]
    begin, end = (float(t) for t in study.excitation.played.window)
    time = np.asarray(observations.time)
    own = np.flatnonzero((time >= begin) & (time <= end))[:: max(1, len(time) // (2 * POINTS))]
    desired = _plain(study.excitation.played.motion(time[own]))
    return (
        Prose(
            f"The virtual robot follows the motion by its servo at {1 / SAMPLE_TIME:g} Hz: cold, "
            "and once more when it is warm. Logs hold what a drive knows: angles of 17-bit motor "
            "encoders and motor torques with 1 % of noise, disturbed by ripple, stiction and "
            "Stribeck friction that the model does not have."
        ),
        Facts(
            (
                ("filter (Eq. 25)", _filter(observations.filter)),
                ("rows of each joint", str(observations.rows)),
                ("largest share of time at a torque limit", f"{100 * run.saturated.max():.2g} %"),
            )
        ),
        Picture(
            filtered_figure(robot, time[own], desired, observations.motion[own], FILTERED),
            "Fig. 5: desired velocity and acceleration, and those that the filter makes of the "
            "measured angles.",
        ),
    )


def _identification(study: Study) -> tuple[AbstractBlock, ...]:
    robot = study.base.model.robot
    plain, weighted = (x.validation.errors[0] for x in (study.unweighted, study.weighted))
    return (
        Picture(
            torque_figure(plain, robot, "identified without weights", SHOWN),
            "Fig. 6: torques of the axes 1, 3, 5 and 7, and what a model says that was identified "
            "without weights.",
        ),
        Picture(
            torque_figure(weighted, robot, "identified with weights", SHOWN),
            "Fig. 7: the same with weights (Eq. 30).",
        ),
    )


def _verification(study: Study) -> tuple[AbstractBlock, ...]:
    robot, path = study.base.model.robot, study.verification
    times = np.linspace(0.0, float(path.duration), FINE)
    motion = _plain(path.motion(times))
    seen = study.weighted.validation.errors
    return (
        Prose(
            "The path after ISO 9283: straight lines, a rectangle and two circles on the plane "
            f"through two opposite edges of a cube of {EDGE:g} m. Where pieces meet the "
            f"end-effector is at rest; speed up to {SPEED:g} m/s, acceleration up to "
            f"{ACCELERATION:g} m/s². The seven joints have one to spare: of all that reach a pose, "
            "those nearest to a posture are taken."
        ),
        Picture(path_figure(robot, motion, times), "Fig. 8: path of the end-effector."),
        Picture(
            pose_figure(robot, motion.q[:: FINE // POINTS], tx90l_on_rail_collision()),
            "The robot with its capsules along the path.",
        ),
        Picture(
            torque_figure(seen[1], robot, "verification", SHOWN),
            "Fig. 9: torques of the axes 1, 3, 5 and 7 on the verification path.",
        ),
        Picture(
            error_figure([seen[0]], [seen[1]], robot),
            "Fig. 10: average errors on identification and verification.",
        ),
        Abreast((_sheet(average_errors(study, 0)), _sheet(average_errors(study, 1)))),
        Prose(
            f"“Moving”: of each axis only rows at more than {AT_REST:g} rad/s or m/s, "
            f"{100 * np.mean(study.moving(1)):.0f} % of the verification. The torque of an axis "
            "that sticks may be anything up to stiction, which no model of speeds can know, and "
            "this path rests at every corner."
        ),
    )


def _temperature(study: Study) -> tuple[AbstractBlock, ...]:
    return (
        Prose(
            "Two identifications of the same motion. Inertial parameters stay, friction falls as "
            "the lubricant warms; a parameter has changed if its difference is more than chance."
        ),
        _sheet(temperature(study)),
        Folded(
            "All base parameters, cold and warm", (Picture(comparison_figure(study.temperature)),)
        ),
    )


def _following(study: Study) -> tuple[AbstractBlock, ...]:
    runs = [(one.name, np.asarray(one.run.time), one.away) for one in study.followed]
    every = max(1, len(runs[0][1]) // (2 * POINTS))
    thinned = [(name, time[::every], away[::every]) for name, time, away in runs]
    return (
        Prose(
            "The verification path once more, with the same servo, and three torques fed forward: "
            "none, those of a CAD model whose bodies are 10 to 18 % off and that knows no "
            "friction, and those of the identified model."
        ),
        _sheet(following(study)),
        Picture(following_figure(thinned), "Distance of the end-effector from where it should be."),
    )


def _assumed(study: Study) -> tuple[AbstractBlock, ...]:
    robot = study.virtual.robot
    return (
        Prose(
            "Six base parameters, cold and warm, are the paper's. What it does not publish is "
            "assumed."
        ),
        Remarks(
            tuple(
                Remark(Tone.PLAIN, _sentence(note))
                for note in (
                    *robot.notes,
                    "assumed: the parameters of bodies, rotors and friction beyond the six that "
                    "are published, and what disturbs.",
                )
            )
        ),
    )


def _filter(filter: AbstractFilter) -> str:
    if not isinstance(filter, PaperFilter):
        return str(filter)
    return (
        f"{filter.velocity:g} rad/s for velocities, {filter.acceleration:g} rad/s forward and "
        "backward for accelerations, forces and columns"
    )


def _sentence(text: str) -> str:
    stop = "" if text.endswith(".") else "."
    return text[0].upper() + text[1:] + stop


def _plain(motion: Motion) -> Motion:
    return Motion(*(np.asarray(x) for x in (motion.q, motion.qd, motion.qdd)))
