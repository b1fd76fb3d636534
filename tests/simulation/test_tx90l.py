"""The paper's robot: its published numbers come out, its bodies could exist."""

import numpy as np
import pytest

from jaxid.dynamics.base import base_parameters
from jaxid.identification.consistency.pseudo_inertia import pseudo_inertia
from jaxid.simulation.tx90l import virtual_tx90l_on_rail

COLD = {1: 273.40, 2: 1.68, 27: 248.41, 28: 41.26, 34: 312.50, 35: 18.24}
WARM = {1: 273.62, 2: 1.65, 27: 90.19, 28: 25.65, 34: 233.00, 35: 15.07}


@pytest.fixture(scope="module")
def base():
    return base_parameters(virtual_tx90l_on_rail().model)


@pytest.mark.parametrize(("warm", "published"), [(False, COLD), (True, WARM)])
def test_published_base_parameters_come_out(base, warm, published):
    assert base.size == 44
    virtual = virtual_tx90l_on_rail(warm=warm)
    truth = np.asarray(base.from_standard(virtual.parameters))
    for number, value in published.items():
        assert truth[number - 1] == pytest.approx(value, abs=5e-9)


def test_temperature_leads_from_cold_to_warm_friction(base):
    cold, warm = (virtual_tx90l_on_rail(warm=w) for w in (False, True))
    heated = np.asarray(base.from_standard(cold.at(45.0).parameters))
    np.testing.assert_allclose(
        heated[26:40], base.from_standard(warm.parameters)[26:40], rtol=1e-9
    )
    between = np.asarray(base.from_standard(cold.at(30.0).parameters))
    assert WARM[27] < between[26] < COLD[27]
    np.testing.assert_allclose(
        between[:26], base.from_standard(cold.parameters)[:26], rtol=1e-12
    )


@pytest.mark.parametrize("warm", [False, True])
def test_bodies_could_exist(warm):
    bodies = np.zeros((7, 10))
    bodies[:, :7] = virtual_tx90l_on_rail(warm=warm).values[:49].reshape(7, 7)
    assert (np.linalg.eigvalsh(pseudo_inertia(bodies))[:, 0] > 1e-7).all()


def test_motors_are_the_papers():
    drives = virtual_tx90l_on_rail().robot.drives
    assert drives.max_torques[0] == pytest.approx(69.0)
    assert drives.max_torques[6] == pytest.approx(2.2)
