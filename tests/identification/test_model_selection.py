"""Errors on unseen parts, and the rule by which a change of a model is kept."""

import numpy as np
import pytest
import virtual

import jaxid as jid
from jaxid.identification.model_selection import (
    HeldOutPrediction,
    ModelChoice,
    Trial,
    UnseenParts,
    column_products,
    divide_logs,
    next_model,
    predict_held_out,
    relative_error,
)
from jaxid.result_table import Status

ROBOT = jid.robots.planar_arm(2, 0.5).replace(limits=jid.Limits(force=[50.0, 8.0]))
MODEL = jid.Model(ROBOT, (jid.RigidBodies(), jid.ViscousFriction()))
BASE = jid.base_parameters(MODEL)
WEIGHTS = np.array([0.3, 2.0])


def logs(count, samples=300):
    p = virtual.standard_parameters(MODEL)
    return [
        virtual.observations(MODEL, p, samples=samples, noise=0.3, seed=k, noise_seed=k)
        for k in range(count)
    ]


def trial(size, *squares):
    return Trial((f"{size}",), size, np.array(squares))


@pytest.mark.parametrize("count", [1, 4])
def test_errors_are_those_of_least_squares_without_the_part(count):
    observed = logs(count)
    parts = divide_logs(observed)
    assert parts.words == ("10 parts of the logs" if count == 1 else "4 logs")
    training = column_products(BASE, observed, parts, WEIGHTS)
    judged = column_products(BASE, observed, parts, np.ones(2))
    products = UnseenParts(
        training, judged, np.zeros((parts.size, BASE.size)), np.full(BASE.size, 1e-12)
    )
    columns = list(range(1, BASE.size))
    found = products.trial((), columns)

    rows = []
    for number, log in enumerate(observed):
        matrix, forces, joints = virtual.dense(BASE, log)
        row = np.repeat(np.arange(log.rows)[:, None], 2, axis=1)[np.asarray(log.mask)]
        part = np.full(len(row), number) if count > 1 else row * 10 // log.rows
        rows.append((matrix[:, columns], forces, WEIGHTS[joints], part))
    matrix, forces, weights, part = map(np.concatenate, zip(*rows, strict=True))
    expected = []
    for k in range(parts.size):
        is_left_out = part == k
        root = np.where(is_left_out, 0.0, weights)
        p, *_ = np.linalg.lstsq(root[:, None] * matrix, root * forces)
        residuals = (matrix @ p - forces)[is_left_out]
        expected.append(residuals @ residuals * parts.size / (forces @ forces))
    np.testing.assert_allclose(found.squares, expected, rtol=1e-6)


def test_bodies_stay_near_the_prior_where_rows_say_nothing():
    observed = logs(1)
    parts = divide_logs(observed)
    products = column_products(BASE, observed, parts, WEIGHTS)
    prior = np.tile(np.arange(1.0, BASE.size + 1), (parts.size, 1))
    free = UnseenParts(products, products, prior, np.full(BASE.size, 1e12))
    held = free.trial((), range(BASE.size)).squares
    for part, square in enumerate(held):
        residual = np.append(prior[part], -1.0)
        expected = residual @ products[part] @ residual
        mean_force = products[:, -1, -1].mean()
        np.testing.assert_allclose(square, expected / mean_force, rtol=1e-6)


def test_predictions_have_not_seen_their_part():
    observed = logs(4)
    estimator = jid.WeightedLeastSquares()
    predictions = predict_held_out(BASE, observed, estimator)
    squares = []
    for number, log in enumerate(observed):
        others = [x for k, x in enumerate(observed) if k != number]
        error = jid.validate(jid.identify(BASE, others, estimator), log).errors[0]
        np.testing.assert_allclose(
            predictions[number].errors, error.errors, rtol=1e-6, atol=1e-9
        )
        squares.append([np.nansum(error.errors**2), np.nansum(error.measured**2)])
    total, forces = np.sum(squares, axis=0)
    assert relative_error(predictions) == pytest.approx(np.sqrt(total / forces))


@pytest.mark.parametrize(
    ("trials", "size"),
    [
        ([trial(10, 4.0, 4.1), trial(11, 3.0, 3.1)], 11),
        # Of two models of one size the one with less error.
        ([trial(10, 3.0, 3.1), trial(10, 2.0, 2.1)], 10),
        # A model that is smaller, and not worse by 1 % of the error.
        ([trial(12, 3.0, 3.1), trial(40, 2.99, 3.09)], 12),
        # Less error on the whole, by one part only.
        ([trial(12, 8.0, 1.0)], None),
        # Half a percent of the error, in each part.
        ([trial(40, 4.95, 4.96)], None),
        ([], None),
    ],
)
def test_a_change_is_kept_if_it_lowers_the_errors_enough(trials, size):
    choice = next_model(trial(8, 5.0, 5.01), trials)
    assert (choice.size if choice else None) == size
    if len(trials) == 2 and trials[0].size == trials[1].size:
        assert choice is trials[1]


def test_a_part_with_large_errors_does_not_hide_a_fall_of_all():
    assert next_model(trial(8, 100.0, 1.0, 2.0), [trial(12, 9.0, 0.1, 0.2)]) is not None
    # Here the part with large errors alone has less.
    assert next_model(trial(8, 100.0, 1.0, 2.0), [trial(12, 60.0, 1.1, 2.1)]) is None


def test_parts_without_rows_do_not_count():
    assert next_model(trial(8, 0.0, 5.0, 5.1), [trial(9, 0.0, 3.0, 3.1)]) is not None


@pytest.mark.parametrize(
    ("promise", "status"), [(0.1, Status.GOOD), (0.3, Status.DOUBTFUL)]
)
def test_a_choice_that_promises_more_error_than_the_file_is_no_tick(promise, status):
    def prediction(error):
        ones = np.ones((1, 1))
        return [HeldOutPrediction("log", np.zeros(1), ones, error * ones)]

    choice = ModelChoice(
        path=[trial(8, 5.0, 5.1), trial(9, 1.0, 1.1)],
        others=[],
        changes={},
        text="",
        predictions=prediction(promise),
        first_predictions=prediction(0.2),
        band="below 10 Hz",
        parts="10 parts of the logs",
        is_complete=True,
    )
    assert choice.remarks[0].status is status
    assert ("record longer" in choice.remarks[0].text) == (promise > 0.2)


def test_short_logs_are_refused():
    with pytest.raises(ValueError, match="at least three blocks"):
        divide_logs([logs(1)[0].replace(mask=np.arange(300)[:, None] < [2, 2])])
