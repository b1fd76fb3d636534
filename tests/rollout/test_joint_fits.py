"""Least squares of joints, their uncertainty, and joints of one kind."""

import dataclasses

import numpy as np
import pytest
import simulated_joints
from simulated_joints import INDEX, parameter_rows

import jaxid as jid
from jaxid.rollout import ServoMotion, ServoSimulator
from jaxid.rollout.determined_combinations import (
    determined_combinations,
    stretch_starts,
)
from jaxid.rollout.effect_choice import undetermined_effects
from jaxid.rollout.equal_joints import joint_groups, pull_equal_joints
from jaxid.rollout.joint_fits import JointFit

TRUTH = {"J": 4e-3, "B": 0.08, "F": 0.01, "d": 0.02}
SYMBOLS = ["J", "B", "d", "F"]
PLACES = [INDEX[symbol] for symbol in SYMBOLS]


def fit_of(logs, symbols=SYMBOLS, **values):
    """Return joints at these parameters, of which some are free."""
    simulator = ServoSimulator(ServoMotion.of(logs).split())
    rows = parameter_rows(logs[0].joints, **values)
    free = np.zeros(rows.shape, bool)
    free[:, [INDEX[symbol] for symbol in symbols]] = True
    return JointFit.of(simulator, rows, free)


def logs_of(amplitudes=(0.4, 0.4), **values):
    commands = [simulated_joints.commands(k, amplitudes) for k in range(4)]
    return [simulated_joints.log(x, **{**TRUTH, **values}) for x in commands]


@pytest.fixture(scope="module")
def logs():
    return logs_of()


def test_a_step_solves_the_least_squares_of_parameters_and_states(logs):
    fit = fit_of(logs, **TRUTH | {"J": 5e-3, "B": 0.07})
    parameters, start = fit.step(np.zeros(2))
    r, S = fit.simulator.sensitivities(fit.parameters, fit.start)
    motions = len(r)
    for j in range(2):
        roots = np.sqrt(fit.weights[:, j])[:, None]
        matrices, errors = [], []
        for m in range(motions):
            of_states = np.zeros((S.shape[-1], 3 * motions))
            of_states[:, 3 * m : 3 * m + 3] = S[m, j, -3:].T
            matrices.append(roots[m] * np.hstack([S[m, j, PLACES].T, of_states]))
            errors.append(-roots[m] * r[m, j])
        certainty = np.sqrt(fit.certainty[:, j].ravel())
        no_parameters = np.zeros((3 * motions, len(PLACES)))
        matrices.append(np.hstack([no_parameters, np.diag(certainty)]))
        errors.append(np.zeros(3 * motions))
        scale = np.linalg.norm(np.vstack(matrices), axis=0)
        solution = np.linalg.lstsq(
            np.vstack(matrices) / scale, np.concatenate(errors), rcond=None
        )
        change = solution[0] / scale
        moved = parameters[j, PLACES] - fit.parameters[j, PLACES]
        np.testing.assert_allclose(moved, change[:4], rtol=1e-6)
        moved = (start - fit.start)[:, j].ravel()
        np.testing.assert_allclose(moved, change[4:], rtol=1e-6, atol=1e-12)


def test_at_a_limit_the_other_parameters_are_optimal(logs):
    """Commands that are stamped late would need a negative delay."""
    late = [
        jid.Recording.of(log.angles[2:], log.forces[:-2], sample_time=log.sample_time)
        for log in logs
    ]
    fit = fit_of(late, **TRUTH).improved(30, tolerance=1e-12)
    assert (fit.parameters[:, INDEX["d"]] == 0.0).all()

    def cost(symbol, change):
        rows = fit.parameters.copy()
        rows[:, INDEX[symbol]] += change
        return fit.with_unknowns(rows, fit.start).cost

    assert (cost("d", 1e-4) > fit.cost).all()
    for symbol in ("J", "B"):
        change = 0.01 * TRUTH[symbol]
        assert (cost(symbol, change) > fit.cost).all()
        assert (cost(symbol, -change) > fit.cost).all()


def test_deviations_are_at_least_those_of_independent_errors(logs):
    """Errors that alternate have no part that slow sensitivities could average."""
    fit = fit_of(logs, **TRUTH)
    path = fit.simulator.positions(fit.parameters, fit.start)
    error = 1e-3
    signs = (-1.0) ** np.arange(path.shape[-1])
    motion = dataclasses.replace(fit.simulator.motion, positions=path + error * signs)
    fit = JointFit.of(
        ServoSimulator(motion), fit.parameters, fit.free, start=fit.start
    ).weighed_by_errors()
    _, S = fit.simulator.sensitivities(fit.parameters, fit.start)
    covariance = determined_combinations(fit, ((0,), (1,))).uncertainty.covariance
    for j in range(2):
        columns = np.concatenate(S[:, j, PLACES], axis=-1)
        independent = error**2 * np.linalg.inv(columns @ columns.T)
        place = slice(4 * j, 4 * j + 4)
        assert (np.diag(covariance)[place] > 0.99 * np.diag(independent)).all()


def test_stretches_hold_one_reversal_each():
    path = np.array([0.0, 1.0, 2.0, 2.0, 2.0, 1.0, 0.0, 0.0, 1.0, 2.0, 1.0, 0.0])
    np.testing.assert_array_equal(stretch_starts(path), [0, 5, 8])
    np.testing.assert_array_equal(stretch_starts(path[:6]), [0])
    np.testing.assert_array_equal(stretch_starts(np.zeros(5)), [0])


def test_errors_that_last_as_long_as_a_stretch_count_once(logs):
    """Each stretch has one error of random sign: variances are sums of squares."""
    fit = fit_of(logs, **TRUTH)
    path = fit.simulator.positions(fit.parameters, fit.start)
    stretches = np.zeros(path.shape, int)
    for m, j in np.ndindex(path.shape[:2]):
        stretches[m, j, stretch_starts(path[m, j])] = 1
    stretches = np.cumsum(stretches, axis=-1)
    signs = np.random.default_rng(0).choice([-1.0, 1.0], (*path.shape[:2], 999))
    errors = 1e-3 * np.take_along_axis(signs, stretches, axis=-1)
    motion = dataclasses.replace(fit.simulator.motion, positions=path + errors)
    fit = JointFit.of(
        ServoSimulator(motion), fit.parameters, fit.free, start=fit.start
    ).weighed_by_errors()
    _, S = fit.simulator.sensitivities(fit.parameters, fit.start)
    by_start = np.einsum("mjst,mjsp->mjpt", S[..., -3:, :], fit.equations.response)
    columns = (S[..., :-3, :] + by_start)[:, :, PLACES]
    covariance = determined_combinations(fit, ((0,), (1,))).uncertainty.covariance
    for j in range(2):
        information = fit.equations.information[:, j].sum(axis=0)
        inverse = np.linalg.inv(information[np.ix_(PLACES, PLACES)])
        variances = 0.0
        for m, k in np.ndindex(len(path), stretches[:, j].max() + 1):
            is_within = stretches[m, j] == k
            score = 1e-3 * fit.weights[m, j] * columns[m, j][:, is_within].sum(axis=-1)
            variances = variances + (inverse @ score) ** 2
        place = slice(4 * j, 4 * j + 4)
        assert (np.diag(covariance)[place] > 0.999 * variances).all()


def test_an_effect_that_never_acts_is_not_determined(logs):
    fit = fit_of(logs, [*SYMBOLS, "um"], **TRUTH, um=5.0)
    k = INDEX["um"]
    np.testing.assert_array_equal(undetermined_effects(fit)[:, k], True)
    fit = fit_of(logs_of(um=0.12), [*SYMBOLS, "um"], **TRUTH, um=0.12).improved(10)
    np.testing.assert_array_equal(undetermined_effects(fit)[:, k], False)


def test_a_joint_that_hardly_moves_takes_over_from_its_equal():
    """Within its dry friction it moves twice in a log."""
    fit = fit_of(logs_of((0.4, 0.012)), **TRUTH).improved(10).weighed_by_errors()
    equal = pull_equal_joints(fit, ((0, 1),))
    truth = np.array(list(TRUTH.values()))
    columns = [INDEX[symbol] for symbol in TRUTH]

    def deviations(fit):
        return np.abs(fit.parameters[1, columns] / truth - 1.0)

    assert deviations(fit).max() > 0.05
    assert deviations(equal).max() < 0.5 * deviations(fit).max()
    np.testing.assert_allclose(equal.parameters[0, columns], truth, rtol=0.02)


def test_joints_of_a_kind_that_differ_are_not_pulled():
    rows = {"J": np.array([4e-3, 6e-3])}
    fit = fit_of(logs_of(**rows), **TRUTH | rows).improved(10).weighed_by_errors()
    pulled = pull_equal_joints(fit, ((0, 1),))
    np.testing.assert_allclose(pulled.parameters[:, INDEX["J"]], rows["J"], rtol=0.01)


def test_names_tell_joints_of_one_kind():
    def kinds(names, alike=None):
        groups = joint_groups(names.split(), alike)
        return [group for group in groups if len(group) > 1]

    assert kinds("FL_hip FL_knee FR_hip FR_knee") == [(0, 2), (1, 3)]
    assert kinds("left_knee_joint right_knee_joint neck") == [(0, 1)]
    assert kinds("joint1 joint2 joint3 joint4 joint5 joint6") == []
    words = [["2", "3"], ["6"]]
    assert kinds("joint1 joint2 joint3 joint6", words) == [(1, 2)]
    # What words do not name is alone, whatever its name.
    assert kinds("left_hip right_hip knee", [["knee"]]) == []


@pytest.mark.parametrize(
    ("alike", "message"),
    [
        ([["elbow"]], "no joint has elbow"),
        ([["hip"], ["left"]], "`left_hip` belongs to two"),
    ],
)
def test_kinds_that_do_not_fit_the_joints_are_rejected(alike, message):
    with pytest.raises(jid.InputError, match=message):
        joint_groups(["left_hip", "right_hip"], alike)
