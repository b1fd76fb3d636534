"""Terms of a model: effects in the equations of motion that are linear in unknown parameters."""

from jaxid.dynamics.terms.friction import AbstractTransition as AbstractTransition
from jaxid.dynamics.terms.friction import AsymmetricCoulombFriction as AsymmetricCoulombFriction
from jaxid.dynamics.terms.friction import AsymmetricViscousFriction as AsymmetricViscousFriction
from jaxid.dynamics.terms.friction import CoulombFriction as CoulombFriction
from jaxid.dynamics.terms.friction import CoupledDrives as CoupledDrives
from jaxid.dynamics.terms.friction import HardSign as HardSign
from jaxid.dynamics.terms.friction import LoadFriction as LoadFriction
from jaxid.dynamics.terms.friction import Reversal as Reversal
from jaxid.dynamics.terms.friction import StribeckFriction as StribeckFriction
from jaxid.dynamics.terms.friction import Tanh as Tanh
from jaxid.dynamics.terms.friction import TemperatureScaled as TemperatureScaled
from jaxid.dynamics.terms.friction import ViscousFriction as ViscousFriction
from jaxid.dynamics.terms.term import AbstractTerm as AbstractTerm
from jaxid.dynamics.terms.term import ConstantOffset as ConstantOffset
from jaxid.dynamics.terms.term import LinearSpring as LinearSpring
from jaxid.dynamics.terms.term import NonlinearParameter as NonlinearParameter
from jaxid.dynamics.terms.term import RigidBodies as RigidBodies
from jaxid.dynamics.terms.term import RotorInertia as RotorInertia
from jaxid.dynamics.terms.term import each_joint as each_joint
