"""A later run added to an earlier one without the earlier data; runs in files."""

import io
import json
import zipfile
from pathlib import Path
from typing import Any

import numpy as np

from jaxid.dynamics.base import BaseParameters
from jaxid.files import written_whole
from jaxid.identification.factors import Blocks, Factors, JointFactor
from jaxid.identification.runs.run import Run, require_same_base
from jaxid.identification.runs.tied import tied

SCHEMA = "jaxid-run/1"
ALIKE = 1e-6
"""Relative difference that two regroupings of one geometry may have."""


def update(earlier: Run, later: Run, name: str | None = None) -> Run:
    """Adds a later run to an earlier one, as if both had been identified together.

    The estimates are those of the joint fit to rounding, and only factors are needed: the earlier
    run may come from a file. If the runs' weights differ, each keeps its own.

    Args:
        earlier: What was known.
        later: What was learned since then, of the robot in the same state.
        name: Of both together; their names in a row if None.

    Raises:
        ValueError: If the runs have different base parameters.
    """
    runs = (earlier, later)
    require_same_base(runs)
    E = np.eye(earlier.base.size)
    found = tied(runs, (E, E))
    parts = (*earlier.blocks.parts, *later.weighted_like(earlier.weights).blocks.parts)
    return Run(
        base=earlier.base,
        blocks=Blocks(parts),
        weights=earlier.weights,
        parameters=found.parameters,
        covariance=found.covariance,
        freedom=found.freedom,
        name=", ".join(run.name for run in runs) if name is None else name,
        recordings=(*earlier.recordings, *later.recordings),
    )


def save_run(path: str | Path, run: Run) -> None:
    """Writes a run to a file (NPZ), whole or not at all; `load_run` reads it back exactly.

    Args:
        path: Of the file; one that is there is replaced.
        run: The run.

    Raises:
        ValueError: If the file's place is no place for a file.
    """
    arrays: dict[str, Any] = {
        key: np.asarray(getattr(run, key))
        for key in ("weights", "parameters", "covariance", "freedom")
    }
    arrays["kappa"] = np.asarray(run.base.kappa)
    for b, part in enumerate(run.blocks.parts):
        for j, joint in enumerate(part.joints):
            arrays[f"R_{b}_{j}"] = np.asarray(joint.R)
    head = {
        "schema": SCHEMA,
        "name": run.name,
        "recordings": run.recordings,
        "names": run.base.names,
        "units": run.base.units,
        "robot": run.base.model.robot.name,
        "columns": [joint.columns for joint in run.blocks.parts[0].joints],
        "rows": [[joint.rows for joint in part.joints] for part in run.blocks.parts],
    }
    arrays["head"] = np.array(json.dumps(head))
    file = io.BytesIO()
    np.savez_compressed(file, **arrays)
    path = Path(path)
    with written_whole(path.absolute().parent) as staging:
        (staging / path.name).write_bytes(file.getvalue())


def load_run(path: str | Path, base: BaseParameters) -> Run:
    """Reads a run that `save_run` has written.

    Args:
        path: Of the file.
        base: The base parameters that it was made with: of the same robot and terms.

    Raises:
        ValueError: If the file holds no run, or one of other base parameters.
    """
    try:
        with np.load(path, allow_pickle=False) as file:
            arrays = dict(file)
        head = json.loads(str(arrays["head"]))
        known = head["schema"] == SCHEMA
    except (ValueError, KeyError, TypeError, EOFError, zipfile.BadZipFile):
        known, head, arrays = False, {}, {}
    if not known:
        raise ValueError(f"`{path}` must hold a run (`{SCHEMA}`), as `save_run` writes it.")
    _require_same(path, head, arrays["kappa"], base)
    columns = [tuple(own) for own in head["columns"]]
    parts = []
    for b, rows in enumerate(head["rows"]):
        joints = (
            JointFactor(own, arrays[f"R_{b}_{j}"], count)
            for j, (own, count) in enumerate(zip(columns, rows, strict=True))
        )
        parts.append(Factors(tuple(joints), base.size))
    return Run(
        base=base,
        blocks=Blocks(tuple(parts)),
        name=head["name"],
        recordings=tuple(head["recordings"]),
        **{key: arrays[key] for key in ("weights", "parameters", "covariance", "freedom")},
    )


def _require_same(path: str | Path, head: dict[str, Any], kappa: np.ndarray, base: BaseParameters):
    for key, own in (("names", base.names), ("units", base.units)):
        if tuple(head[key]) != own:
            pairs = zip(head[key], own, strict=False)
            there, here = next(((a, b) for a, b in pairs if a != b), ("more", "fewer"))
            raise ValueError(
                f"`{path}` holds a run of other base parameters than `base`: {key} differ, "
                f"`{there}` there and `{here}` here; use the robot and the terms of the file."
            )
    if kappa.shape != base.kappa.shape or not np.allclose(kappa, base.kappa, ALIKE, ALIKE):
        raise ValueError(
            f"`{path}` holds a run of `{head['robot']}` with another geometry than that of `base`: "
            "lengths differ; use the robot of the file."
        )
