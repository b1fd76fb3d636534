"""The robot of most tests here."""

import pytest
from virtual import planar_base

import jaxid as jid


@pytest.fixture(scope="session")
def base() -> jid.BaseParameters:
    """Twelve base parameters of a planar arm: two joints with friction and offsets."""
    return planar_base()
