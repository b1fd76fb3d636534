import numpy as np
import pytest

import jaxid as jid
from jaxid.dynamics.dispatch import program_of
from jaxid.program import evaluate, select_outputs, trace


@pytest.mark.parametrize("name", ["panda", "tx90l_on_rail"])
def test_the_base_regressor_follows_from_the_regressors_program(name):
    base = jid.base_parameters(jid.Model(getattr(jid.robots, name)()))
    n = (base.model.robot.joints,)
    program, traced = program_of(base, base.columns, n, n, n), trace(base.columns, n, n, n)
    assert program.counts.total <= traced.counts.total
    np.testing.assert_array_equal(program.nonzeros, traced.nonzeros)
    x = np.random.default_rng(0).normal(size=(3, *n, 5))
    np.testing.assert_allclose(evaluate(program, *x), evaluate(traced, *x), atol=1e-12)


def test_what_chosen_results_do_not_need_is_left_out():
    program = trace(lambda x: np.array([[1.0, 2.0]]) * x[0] * (x[1] + 3.0), (2,))
    second = select_outputs(program, np.array([1]))
    assert second.output_shapes == ((1,),)
    assert len(second.nodes) < len(program.nodes)
    x = np.random.default_rng(0).normal(size=(2, 4))
    np.testing.assert_array_equal(evaluate(second, x), evaluate(program, x)[0, 1:])
    constant = select_outputs(trace(lambda x: 0.0 * x, (2,)), np.array([0]))
    np.testing.assert_array_equal(evaluate(constant, x), np.zeros((1, 4)))
