"""The demo's results for programs."""

from typing import Any

import numpy as np

from jaxid.experiment.demo import DEMO
from jaxid.experiment.demo import study as settings
from jaxid.experiment.demo.study import Judged, Study
from jaxid.experiment.demo.tables import ASKED, TEMPERATURE, errors, keeps, moving_errors
from jaxid.report.content import plain, versions


def record(study: Study) -> dict[str, Any]:
    """Everything that the demo has found, in units of rad, m, s, N and N m.

    Args:
        study: What was found.
    """
    base, excitation = study.base, study.excitation
    robot = base.model.robot
    fits = (study.weighted.fit, study.warm)
    return plain(
        {
            "schema": DEMO,
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
                "every": settings.EVERY,
                "at_rest": settings.AT_REST,
                "filter": str(study.measured.filtered[0].filter),
                "path": {
                    "cube_centre": settings.CUBE,
                    "cube_edge": settings.EDGE,
                    "attitude": settings.FORWARD,
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
                        "numbers": np.asarray(plan.numbers),
                    }
                    for plan in excitation.plans
                ],
                "series": _series(excitation.played.inner, settings.HARMONICS),
                "tip_speed": excitation.speed,
                "tip_acceleration": excitation.acceleration,
                "window": [float(t) for t in excitation.played.window],
            },
            "estimates": {
                one.name: _judged(one, study)
                for one in (study.unweighted, study.weighted, study.consistent, study.true)
            },
            "below_one_percent": keeps(study),
            "asked_percent": ASKED,
            "temperature": [
                {
                    "number": p.number,
                    "name": base.names[p.number - 1],
                    "expression": base.expressions[p.number - 1],
                    "unit": p.unit,
                    "paper": [p.cold, p.warm],
                    "estimates": [float(f.parameters[p.number - 1]) for f in fits],
                    "standard_deviations": [
                        float(f.standard_deviations[p.number - 1]) for f in fits
                    ],
                    "verdict": study.temperature.verdicts[p.number - 1].value,
                }
                for p in TEMPERATURE
            ],
            "coverage": [
                {"filter": c.filter, "inside": c.inside, "of": c.of, "share": c.share}
                for c in study.coverage
            ],
            "following": [
                {
                    "fed_forward": one.name,
                    "tip_rms": one.rms,
                    "tip_largest": one.largest,
                    "joint_rms": one.joints,
                    "saturated": np.asarray(one.run.saturated),
                }
                for one in study.followed
            ],
            "feed_forward": study.timing
            if isinstance(study.timing, str)
            else {
                "where": study.timing.where,
                "eq_39": study.timing.literal,
                "eq_39_factored": study.timing.factored,
                "eq_38": study.timing.full,
            },
        }
    )


def _series(series: Any, harmonics: int) -> dict[str, Any]:
    x = np.asarray(series.coefficients)
    return {
        "offset": x[:, 0],
        "a": x[:, 1 : harmonics + 1],
        "b": x[:, harmonics + 1 :],
        "omega": float(series.basis.omega),
    }


def _judged(judged: Judged, study: Study) -> dict[str, Any]:
    fit, found = judged.fit, judged.validation
    return {
        "parameters": np.asarray(fit.parameters),
        "standard_deviations": fit.standard_deviations,
        "mean_percent_identification": errors(judged, 0),
        "mean_percent_verification": errors(judged, 1),
        "mean_percent_moving": [moving_errors(study, judged, k) for k in (0, 1)],
        "rms_percent_identification": found.errors[0].rms_percent,
        "rms_percent_verification": found.errors[1].rms_percent,
        "smallest_eigenvalue": found.definiteness.smallest,
        "indefinite_share": found.definiteness.indefinite,
    }
