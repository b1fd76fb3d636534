"""Former names of `jaxid.dynamics.dispatch`."""

from jaxid.dynamics.dispatch import FEW as FEW
from jaxid.dynamics.dispatch import in_numpy as in_numpy
from jaxid.dynamics.dispatch import on_samples as on_samples
from jaxid.dynamics.dispatch import program_of as program_of
