"""Former place of friction terms, now `jaxid.dynamics.terms`."""

from jaxid.dynamics.terms import AsymmetricViscousFriction as AsymmetricViscousFriction
from jaxid.dynamics.terms import LoadFriction as LoadFriction
from jaxid.dynamics.terms import StribeckFriction as StribeckFriction
from jaxid.dynamics.terms import TemperatureScaled as TemperatureScaled
