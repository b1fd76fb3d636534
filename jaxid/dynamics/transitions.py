"""Former place of transitions, now `jaxid.dynamics.terms`."""

from jaxid.dynamics.terms import AbstractTransition as AbstractTransition
from jaxid.dynamics.terms import HardSign as HardSign
from jaxid.dynamics.terms import NonlinearParameter as Shape  # noqa: F401
from jaxid.dynamics.terms import Reversal as Reversal
from jaxid.dynamics.terms import Tanh as Tanh
