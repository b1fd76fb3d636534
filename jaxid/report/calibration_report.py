"""Report of a kinematic calibration: page, numbers, and the calibrated robot."""

import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from jaxid.arrays import Matrix, Vector
from jaxid.calibration import GeometryFit, propose_sessions
from jaxid.calibration.pose_proposals import mean_place
from jaxid.errors import InputError
from jaxid.excitation.constraints import Clearance
from jaxid.export.calibrated_origins import export_origins
from jaxid.io import FilePath
from jaxid.result_table import Remark, Table, percent, significant
from jaxid.robot.description_files import is_mjcf
from jaxid.robot.forward_kinematics import tip_jacobian
from jaxid.robot.limits_and_drives import complete_limits

from .figure import Figure
from .figure_elements import BLUE, GREY, VERMILION, Curve, Panel
from .result_files import write_csv
from .result_records import Record, estimate_rows
from .several_runs_report import Answer, RunsReport

CLASSES = {"below the median": GREY, "above it": BLUE, "largest tenth": VERMILION}
"""Classes of errors in the workspace, and their colours."""
QUANTILES = (0.5, 0.9)
"""Shares of the poses below the ends of the classes."""
MIN_NARROWING = 0.05
"""Share of the intervals below which another session does not pay."""
MIN_SHARE_OF_RANGE = 0.3
"""Share of its range that each joint should use in all poses together."""
HOW_TO_READ = (
    "A combination is named after one correction; the table before shows which others "
    "the poses cannot tell from it. Intervals take the session as the unit."
)


@dataclasses.dataclass(frozen=True, eq=False)
class CalibrationReport(RunsReport):
    """Result of a kinematic calibration; the robot's file is written, too.

    Attributes:
        poses_to_record: Rows of the table of poses that are proposed.
    """

    poses_to_record: Sequence[Record] = ()

    @property
    def verdict(self) -> Remark:
        """Whether the geometry can be used, in one sentence."""
        return self.result.verdict

    def overview(self) -> list:
        """Return verdict, findings and errors of the sessions."""
        return [Table("", remarks=self.findings), self.details[0]]

    def save(self, folder: FilePath) -> list[Path]:
        """Write page, numbers, poses to record, and the robot's file."""
        files = super().save(folder)
        if self.poses_to_record:
            files.append(Path(folder) / "poses_to_record.csv")
            write_csv(files[-1], list(self.poses_to_record))
        source = Path(self.result.problem.robot.source)
        if source.is_file():
            name = "robot.xml" if is_mjcf(source) else "robot.urdf"
            files.append(export_origins(self.result, Path(folder) / name))
        return files


def calibration_report(
    fit: GeometryFit,
    sources: Mapping[str, Sequence[Path]],
    clearance: Clearance | None,
    units: Vector,
    findings: Sequence[Remark] = (),
) -> CalibrationReport:
    """Return the report of a calibration.

    Args:
        fit: Calibrated geometry.
        sources: Files of each session.
        clearance: Distance that shapes keep in poses that are proposed.
        units: Units of the joint coordinates in files [rad or m].
        findings: Further findings.
    """
    run = fit.run
    rows = estimate_rows(run.names, run.units, run.parameters, fit.uncertainty)
    for row, kind in zip(rows, run.kinds, strict=True):
        row["kind"] = kind
        row["dof"] = run.dof
    sessions, corrections, _, undetermined = fit.tables()
    proposals = _proposals(fit, clearance)
    advice = [Remark(x) for x in _advice(fit, proposals, clearance)]
    return CalibrationReport(
        "calibration",
        fit,
        _answer(fit),
        rows,
        _content(fit),
        sources,
        findings=[*fit.findings, *findings, *advice],
        details=[sessions, corrections, undetermined],
        poses_to_record=_rows(fit, proposals, units),
    )


def _proposals(fit: GeometryFit, clearance: Clearance | None) -> list[np.ndarray]:
    """Return sessions to record next; none if the tool reaches no place."""
    try:
        return propose_sessions(fit, clearance=clearance)
    except InputError:
        return []


def _advice(
    fit: GeometryFit, proposals: list[np.ndarray], clearance: Clearance | None
) -> list[str]:
    """Return which poses are missing, and whether more of them pay."""
    robot = fit.problem.robot
    q = fit.problem.poses.q[fit.problem.poses.is_pose]
    limits = complete_limits(robot)
    shares = np.ptp(q, axis=0) / (limits.position_max - limits.position_min)
    narrow_joints = [
        f"`{robot.joint_names[joint]}` ({percent(shares[joint])} %)"
        for joint in np.flatnonzero(shares < MIN_SHARE_OF_RANGE)
    ]
    sentences = []
    if narrow_joints:
        sentences.append(
            "Postures are missing: of their ranges, the poses use little of "
            + ", ".join(narrow_joints)
        )
    narrowing = fit.next_narrowing
    sentence = f"One more session would narrow the intervals by {percent(narrowing)} %"
    if narrowing < MIN_NARROWING:
        sentence += ": more sessions hardly pay"
    if not proposals:
        return [*sentences, f"{sentence}; no place to record was found"]
    shapes = "not checked for collisions" if clearance is None else "without collision"
    where = [str(mean_place(fit, q).round(2).tolist()) for q in proposals]
    sentences.append(
        f"{sentence}; places far from the others are near {', '.join(where)} m: "
        f"`poses_to_record.csv` (within limits, {shapes})"
    )
    return sentences


def _rows(fit: GeometryFit, proposals: list[np.ndarray], units: Vector) -> list[Record]:
    """Return a row for each pose to record, with angles in the files' unit."""
    names = ("session", *fit.problem.robot.joint_names)
    return [
        dict(zip(names, [session, *q], strict=True))
        for session, poses in enumerate(proposals, 1)
        for q in (poses / units).tolist()
    ]


def _content(fit: GeometryFit) -> Record:
    """Return numbers for programs."""
    robot = fit.problem.robot
    return {
        "joints": robot.body_names,
        "origins": fit.origins,
        "compliances": fit.compliances,
        "tools": {
            name: frame._asdict()
            for (session, name), frame in fit.frames.items()
            if not session
        },
        "prior": fit.solution.prior._asdict(),
        "poses": fit.problem.pose_names,
        "errors": fit.errors._asdict(),
        "nominal_errors": fit.shown_errors.nominal._asdict(),
        "held_out_errors": fit.shown_errors.calibrated._asdict(),
        "left_out": fit.solution.is_wrong,
    }


def _answer(fit: GeometryFit) -> Answer:
    """Return what the page says and shows."""
    errors = fit.shown_errors
    before, after = (fit.mean_error(x) for x in (errors.nominal, errors.calibrated))
    shift = np.abs(fit.origins[:, :3]).max()
    turn = np.abs(fit.origins[:, 3:]).max()
    numbers = [
        (f"{significant(1e3 * after)} mm", f"mean error, {fit.manner}"),
        (f"{significant(1e3 * before)} mm", "mean error of the nominal geometry"),
        (
            f"{significant(1e3 * shift)} mm, {significant(1e3 * turn)} mrad",
            "largest corrections",
        ),
    ]
    return Answer(
        f"{fit.problem.robot.name}: calibrated geometry",
        fit.verdict.text,
        numbers,
        [workspace_figure(fit)],
        HOW_TO_READ,
    )


def workspace_figure(fit: GeometryFit) -> Figure:
    """Return the error of every pose in the workspace, before and after."""
    poses = fit.problem.poses
    names = np.array(fit.problem.pose_names)[poses.is_pose]
    points = tip_jacobian(fit.problem.robot, poses.q[poses.is_pose]).position
    panels = []
    for title, errors in (
        ("nominal", fit.shown_errors.nominal),
        ("calibrated", fit.shown_errors.calibrated),
    ):
        lengths = errors.lengths[poses.is_pose]
        for view, axes in (("from above", (0, 1)), ("from the side", (0, 2))):
            labels = [f"{'xyz'[axis]} [m]" for axis in axes]
            curves = _classes(points[:, axes], lengths, names)
            panels.append(Panel(curves, f"{title}, {view}", x=labels[0], y=labels[1]))
    return Figure(f"errors in the workspace, {fit.manner}", panels, columns=2)


def _classes(places: Matrix, lengths: Vector, names: np.ndarray) -> list[Curve]:
    """Return the poses of each class of errors as points."""
    classes = np.searchsorted(np.quantile(lengths, QUANTILES), lengths)
    curves = []
    for number, (name, colour) in enumerate(CLASSES.items()):
        poses = classes == number
        x, y = places[poses].T
        pairs = zip(names[poses], 1e3 * lengths[poses], strict=True)
        texts = [f"{name}: {length:.3g} mm" for name, length in pairs]
        curves.append(Curve(x, y, name, colour, kind="points", texts=texts))
    return curves
