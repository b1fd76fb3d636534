"""Leads of a given time: standstill at both ends, and what is measured between."""

import numpy as np
import pytest

from jaxid.trajectory.leads_basis import LeadsBasis

BASIS = LeadsBasis(3, 1.1, lead=0.4, periods=2)
NUMBERS = np.random.default_rng(0).standard_normal((2, 7))


def test_starts_and_stops_at_rest_and_passes_smoothly():
    t = np.array([0.0, BASIS.duration])
    np.testing.assert_allclose(BASIS.rows(t)[1:3] @ NUMBERS.T, 0.0, atol=1e-12)
    for seam in (0.4, BASIS.duration - 0.4):
        before, after = BASIS.rows(np.array([seam - 1e-9, seam + 1e-9])).swapaxes(0, 1)
        np.testing.assert_allclose(before[:3] @ NUMBERS.T, after[:3] @ NUMBERS.T, atol=1e-6)


def test_one_period_is_measured_and_the_leads_are_watched():
    times, instants = BASIS.times(50), BASIS.instants(200)
    assert times[0] == pytest.approx(0.4)
    assert times[-1] < 0.4 + BASIS.series.duration
    assert instants[0] == 0.0
    assert instants[-1] == pytest.approx(BASIS.duration)
    assert (np.diff(instants) > 0).all()
    assert (instants < 0.4).any()
    assert (instants > BASIS.duration - 0.4).any()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [({"lead": 0.0}, "`lead` must be a positive"), ({"periods": 0}, "`periods` must be at least")],
)
def test_refuses(arguments, message):
    with pytest.raises(ValueError, match=message):
        LeadsBasis(3, 1.1, **arguments)
