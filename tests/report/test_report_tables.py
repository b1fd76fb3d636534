"""Tables: what stands in them, with units."""

import dataclasses
import io

import numpy as np
import pytest
from report_samples import arm_of, errors_of
from rich.console import Console

from jaxid.report.tables import error_table, joint_table, parameter_table, residual_table


def lines(table, width=140) -> list[str]:
    out = io.StringIO()
    Console(file=out, width=width).print(table)
    return out.getvalue().splitlines()


def test_parameters_have_estimate_deviation_and_unit(fit):
    text = lines(parameter_table(fit))
    assert text[0].startswith(f"cart: {fit.base.size} base parameters")
    for k, expression in enumerate(fit.base.expressions):
        row = text[2 + k]
        assert expression in row
        assert fit.base.units[k] in row
        numbers = [float(x) for x in row.split() if x.replace(".", "").lstrip("-").isdigit()]
        assert numbers[0] == k + 1
        slack = 0.5 * fit.standard_deviations[k]
        assert any(abs(x - fit.parameters[k]) <= slack for x in numbers[1:])
    plain = "\n".join(lines(parameter_table(fit, expressions=False)))
    assert all(name in plain for name in fit.base.names)


def test_deviations_stand_beside_the_naive_ones(fit):
    def naive(k):
        return float(f"{fit.naive_standard_deviations[k]:.1e}")

    text = lines(parameter_table(fit))
    assert text[1].split()[-3:] == ["naive", "±", "ratio"]
    for k, ratio in enumerate(fit.uncertainty.ratios):
        last = [float(x) for x in text[2 + k].split()[-2:]]
        assert last == [pytest.approx(naive(k)), pytest.approx(ratio, rel=0.06)]
    alone = dataclasses.replace(fit, uncertainty=type(fit.uncertainty).given(fit.covariance))
    assert "naive" not in lines(parameter_table(alone))[1]


def test_residuals_are_white_or_not(fit):
    spectra = fit.residual_spectra
    text = lines(residual_table(spectra, fit.base.model.robot))
    for row, white, slow in zip(text[3:], spectra.white, spectra.slow, strict=True):
        assert ("yes" if white else "no") in row.split()
        assert float(row.split()[-1]) == pytest.approx(100 * slow, rel=0.06)


def test_errors_have_joints_and_units(fit, validation):
    errors, robot = validation.errors[1], fit.base.model.robot
    text = "\n".join(lines(error_table(errors, robot)))
    for word in ("second", "rail", "swing_$1_$", " N ", " N m ", "[% of max]", "average"):
        assert word in text
    assert f"{errors.mean_percent[0]:.3g}" in text


def test_unknown_largest_forces_are_dashes():
    errors = dataclasses.replace(errors_of(2), max_forces=np.full(2, np.nan))
    text = lines(error_table(errors, arm_of(2)))
    assert "average" not in "\n".join(text)
    assert sum("–" in row for row in text) == 2  # noqa: RUF001


def test_joints_have_limits_and_units(fit):
    text = lines(joint_table(fit.base.model.robot), width=80)
    rail = next(row for row in text if row.startswith("rail"))
    assert rail.split() == ["rail", "slides", *"––", "1.00", "–", "200", "m", "N"]  # noqa: RUF001
    swing = next(row for row in text if row.startswith("swing"))
    assert "turns" in swing
    assert swing.rstrip().endswith("N m")


def test_refuses_another_robot():
    with pytest.raises(ValueError, match="belong to 3 joints"):
        error_table(errors_of(3), arm_of(2))
