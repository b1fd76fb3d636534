"""Comparison with golden results: numbers of whole runs that no change may move.

The tolerance is 1e-9 relative; `JAXID_GOLDEN_TOLERANCE` widens it for machines with
other instruction sets. To record new values after an intended change, delete the file
of that case, run the test, and say in CHANGELOG.md what changed and why.
"""

import json
import os
import sys
from pathlib import Path

import numpy as np
import pytest

from jaxid.cli import app as cli

HERE = Path(__file__).resolve().parent / "golden"
TOLERANCE = float(os.environ.get("JAXID_GOLDEN_TOLERANCE", "1e-9"))


def command(*words):
    """Run a command line here; it may call a model unusable (3), all else fails."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "argv", ["jaxid", *map(str, words)])
        with pytest.raises(SystemExit) as stopped:
            cli.main()
    assert stopped.value.code in (0, 3)


def numbers_of_report(folder):
    """Return the numbers of a report that belong to the estimates."""
    found = json.loads((folder / "result.json").read_text(encoding="utf-8"))
    errors = found["errors"]["identification"] + found["errors"]["verification"]
    return {
        "parameters": {p["name"]: p["estimate"] for p in found["base_parameters"]},
        "deviations": {
            p["name"]: p["standard_deviation"] for p in found["base_parameters"]
        },
        "condition_numbers": found["fit"]["condition_numbers"],
        "residual": found["fit"]["residual"],
        "residual_rms": found["fit"]["residual_rms"],
        "errors": {e["recording"]: [j["rms"] for j in e["joints"]] for e in errors},
        "relative_errors": {e["recording"]: e["relative"] for e in errors},
    }


def require_same_results(first, second):
    """Require that two reports say the same, but for the settings that led to them."""
    first_results, second_results = (
        json.loads((place / "result.json").read_text(encoding="utf-8"))
        for place in (first, second)
    )
    for key in ("base_parameters", "fit", "errors", "consistency", "notes", "verdict"):
        assert first_results[key] == second_results[key], key


def compare(case, found, tolerance=TOLERANCE):
    """Compare numbers with a case's golden file; write it and fail without one."""
    path = HERE / f"{case}.json"
    if not path.exists():
        path.write_text(json.dumps(found, indent=1) + "\n", encoding="utf-8")
        pytest.fail(
            f"`{path.name}` was missing and has been recorded: check it, then run "
            "again."
        )
    _compare(case, json.loads(json.dumps(found)), golden(case), tolerance)


def golden(case):
    """Return the golden values of a case."""
    return json.loads((HERE / f"{case}.json").read_text(encoding="utf-8"))


def _compare(place, found, golden, tolerance):
    assert type(found) is type(golden), place
    if isinstance(golden, dict):
        assert list(found) == list(golden), place
        # Values of one kind share a scale: a parameter near zero is compared with the
        # largest.
        flat = all(isinstance(x, float | int) for x in golden.values())
        if flat and golden and "condition" not in place:
            _close(place, list(found.values()), list(golden.values()), tolerance)
            return
        for key in golden:
            _compare(f"{place}.{key}", found[key], golden[key], tolerance)
    else:
        _close(place, found, golden, tolerance)


def _close(place, found, golden, tolerance):
    found, golden = np.asarray(found, float), np.asarray(golden, float)
    scale = np.maximum(np.abs(golden), 1e-3 * np.abs(golden).max(initial=0.0))
    worst = np.max(
        np.abs(found - golden) / np.where(scale > 0, scale, 1.0), initial=0.0
    )
    assert worst <= tolerance, f"{place}: {worst:.1e}"
