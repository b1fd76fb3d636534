import numpy as np
import pytest

import jaxid as jid
from jaxid.program import evaluate, trace
from jaxid.program.sample_methods import program_of


@pytest.mark.parametrize("name", ["panda", "tx90l_on_rail"])
def test_the_base_regressor_follows_from_the_regressors_program(name):
    base = jid.base_parameters(jid.Model(getattr(jid.robots, name)()))
    n = (base.model.robot.joints,)
    program, traced = (
        program_of(base, base.columns, n, n, n),
        trace(base.columns, n, n, n),
    )
    assert program.counts.total <= traced.counts.total
    np.testing.assert_array_equal(program.nonzeros, traced.nonzeros)
    x = np.random.default_rng(0).normal(size=(3, *n, 5))
    np.testing.assert_allclose(evaluate(program, *x), evaluate(traced, *x), atol=1e-12)
