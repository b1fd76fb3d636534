"""Agreement of reports: fits, rollouts and calibrations of one robot."""

import dataclasses
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from jaxid.errors import InputError
from jaxid.identification.agreement import Agreement, agreement
from jaxid.identification.fit_result import Fit
from jaxid.identification.run_to_run import Run
from jaxid.io import read_json
from jaxid.report.agreement_page import agreement_answer
from jaxid.report.result_files import MODEL, read_fit
from jaxid.report.result_records import Record, table_rows
from jaxid.report.several_runs_report import RunsReport

RESULT_FILES = ("rollout.json", "calibration.json")
"""Files of reports whose estimates are compared, besides the model of a fit."""


def agree_reports(reports: Sequence[Path]) -> RunsReport:
    """Compare the results of several reports of one robot, and pool those that agree.

    Args:
        reports: Folders that `jaxid identify`, `rollout` or `calibrate` has written,
            all by the same command, in the order of the runs.

    Raises:
        InputError: If there are fewer than two, a folder holds no such result, or the
            parameters of two differ.
    """
    if len({path.resolve() for path in reports}) < max(2, len(reports)):
        raise InputError(
            "`reports` must be two or more different folders, but are: "
            f"{', '.join(map(str, reports))}."
        )
    result_files = [result_file(path) for path in reports]
    if len(set(result_files)) > 1:
        raise InputError(
            "`reports` must be written by one command, but their results are "
            f"{', '.join(f'`{x}`' for x in dict.fromkeys(result_files))}."
        )
    short_names = [path.name for path in reports]
    has_short_names = len(set(short_names)) == len(reports)
    names = short_names if has_short_names else [str(path) for path in reports]
    results = [read_run(*pair) for pair in zip(reports, names, strict=True)]
    result = agreement(results)
    content = {
        "odd_runs": [{**x._asdict(), **x.cause._asdict()} for x in result.odd],
        "drifts": [drift._asdict() for drift in result.drifts],
        "factors": result.factors._asdict(),
        "excess": result.excess,
    }
    return RunsReport(
        "agreement",
        result,
        agreement_answer(result),
        pooled_rows(result),
        content,
        {name: [path] for name, path in zip(names, reports, strict=True)},
        (),
        details=[result.parameter_table()],
    )


def pooled_rows(result: Agreement) -> list[Record]:
    """Return the pooled estimates, one row each."""
    intervals = result.intervals()
    return table_rows(
        name=result.names,
        unit=result.units,
        kind=result.kinds,
        estimate=result.parameters,
        low_95=intervals[:, 0],
        high_95=intervals[:, 1],
        spread=np.sqrt(result.spreads),
    )


def result_file(report: Path) -> str:
    """Return the name of the file that holds the result of a report."""
    for file in (*RESULT_FILES, MODEL):
        if (report / file).is_file():
            return file
    if report.is_dir():
        raise InputError(
            f"`{report}` must be a folder of `jaxid identify`, `rollout` or "
            f"`calibrate`, but holds neither `{MODEL}` nor "
            f"`{'` nor `'.join(RESULT_FILES)}`."
        )
    return MODEL


def read_run(report: Path, name: str) -> Fit | Run:
    """Return the result that a report holds, under a name."""
    file = result_file(report)
    if file in RESULT_FILES:
        return _run_of_rows(name, read_json(report / file)["parameters"])
    return dataclasses.replace(read_fit(report), name=name)


def _run_of_rows(name: str, rows: Sequence[Record]) -> Run:
    """Return the estimates of a result file, by their own deviations."""
    deviations = np.array([row["standard_deviation"] for row in rows], float)
    if not np.isfinite(deviations).all():
        raise InputError(
            f"`{name}` must have intervals, but has none: calibrate with at least two "
            "sessions."
        )
    # Not all parameters belong to a joint.
    joints = [f" ({row['joint']})" if "joint" in row else "" for row in rows]
    return Run(
        name=name,
        names=tuple(
            row["name"] + joint for row, joint in zip(rows, joints, strict=True)
        ),
        units=tuple(row["unit"] for row in rows),
        kinds=tuple(row["kind"] for row in rows),
        parameters=np.array([row["estimate"] for row in rows], float),
        covariance=np.diag(deviations**2),
        dof=float(np.median([row["dof"] for row in rows])),
    )
