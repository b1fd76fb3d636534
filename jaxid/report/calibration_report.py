"""Report of a kinematic calibration: page, numbers, and the calibrated robot."""

import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from jaxid.arrays import Vector
from jaxid.calibration import GeometryFit
from jaxid.export.calibrated_origins import export_origins
from jaxid.io import FilePath
from jaxid.result_table import Remark, significant
from jaxid.robot.description_files import is_mjcf
from jaxid.robot.forward_kinematics import tip_jacobian

from .figure import Figure
from .figure_elements import BLUE, GREY, VERMILION, Curve, Panel
from .result_records import Record, estimate_rows
from .several_runs_report import Answer, RunsReport

CLASSES = {"below the median": GREY, "above it": BLUE, "largest tenth": VERMILION}
"""Classes of errors in the workspace, and their colours."""
QUANTILES = (0.5, 0.9)
"""Shares of the poses below the ends of the classes."""
HOW_TO_READ = (
    "A combination is named after one correction; the table before shows which others "
    "the poses cannot tell from it. Intervals take the session as the unit."
)


@dataclasses.dataclass(frozen=True, eq=False)
class CalibrationReport(RunsReport):
    """Result of a kinematic calibration; the robot's file is written, too."""

    @property
    def verdict(self) -> Remark:
        """Whether the geometry can be used, in one sentence."""
        return self.result.verdict

    def overview(self) -> list:
        """Return verdict, findings and errors of the sessions."""
        return self.result.overview()

    def save(self, folder: FilePath) -> list[Path]:
        """Write page, numbers, and the robot with calibrated origins."""
        files = super().save(folder)
        source = Path(self.result.problem.robot.source)
        if not source.is_file():
            return files
        name = "robot.xml" if is_mjcf(source) else "robot.urdf"
        path = export_origins(self.result, Path(folder) / name)
        return [*files, path]


def calibration_report(
    fit: GeometryFit, sources: Mapping[str, Sequence[Path]]
) -> CalibrationReport:
    """Return the report of a calibration.

    Args:
        fit: Calibrated geometry.
        sources: Files of each session.
    """
    run = fit.run
    rows = estimate_rows(run.names, run.units, run.parameters, fit.uncertainty)
    for row, kind in zip(rows, run.kinds, strict=True):
        row["kind"] = kind
        row["dof"] = run.dof
    sessions, corrections, _, undetermined = fit.tables()
    return CalibrationReport(
        "calibration",
        fit,
        _answer(fit),
        rows,
        _content(fit),
        sources,
        findings=fit.findings,
        details=[sessions, corrections, undetermined],
    )


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
        [pose_error_figure(fit), workspace_figure(fit)],
        HOW_TO_READ,
    )


def pose_error_figure(fit: GeometryFit) -> Figure:
    """Return the error of every pose before and after, one panel for each session."""
    errors = fit.shown_errors
    panels = []
    for session, poses in zip(
        fit.problem.sessions, fit.problem.poses_of_sessions, strict=True
    ):
        numbers = np.arange(1, len(poses) + 1)
        before = 1e3 * errors.nominal.lengths[poses]
        after = 1e3 * errors.calibrated.lengths[poses]
        curves = [
            Curve(numbers, before, "nominal", GREY, kind="points"),
            Curve(numbers, after, "calibrated", BLUE, kind="points"),
        ]
        mean = f"{significant(before.mean())} → {significant(after.mean())} mm"
        panels.append(
            Panel(curves, session, mean, x="pose", y="error", unit="mm", log="y")
        )
    return Figure(f"error of every pose, {fit.manner}", panels, columns=2)


def workspace_figure(fit: GeometryFit) -> Figure:
    """Return where in the workspace errors are left, from above and from the side."""
    problem = fit.problem
    is_pose = problem.poses.is_pose
    points = tip_jacobian(problem.robot, problem.poses.q[is_pose]).position
    panels = []
    for title, errors in (
        ("nominal", fit.shown_errors.nominal.lengths),
        ("calibrated", fit.shown_errors.calibrated.lengths),
    ):
        lengths = errors[is_pose]
        for view, axes in (("from above", (0, 1)), ("from the side", (0, 2))):
            labels = [f"{'xyz'[axis]} [m]" for axis in axes]
            curves = _classes(points[:, axes], lengths)
            panels.append(Panel(curves, f"{title}, {view}", x=labels[0], y=labels[1]))
    return Figure(f"errors in the workspace, {fit.manner}", panels, columns=2)


def _classes(places: np.ndarray, lengths: Vector) -> list[Curve]:
    """Return the poses of each class of errors as points."""
    classes = np.searchsorted(np.quantile(lengths, QUANTILES), lengths)
    curves = []
    for number, (name, colour) in enumerate(CLASSES.items()):
        poses = classes == number
        x, y = places[poses].T
        texts = [f"{length:.2f} mm" for length in 1e3 * lengths[poses]]
        curves.append(Curve(x, y, name, colour, kind="points", texts=texts))
    return curves
