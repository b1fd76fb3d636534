"""Terms of a model: effects in the equations of motion that are linear in unknown parameters."""

from .bodies_rotors_springs import (
    ConstantOffset as ConstantOffset,
    LinearSpring as LinearSpring,
    RigidBodies as RigidBodies,
    RotorInertia as RotorInertia,
    TorqueRipple as TorqueRipple,
)
from .friction import (
    AbstractTransition as AbstractTransition,
    AsymmetricCoulombFriction as AsymmetricCoulombFriction,
    AsymmetricViscousFriction as AsymmetricViscousFriction,
    CoulombFriction as CoulombFriction,
    CoupledDrives as CoupledDrives,
    HardSign as HardSign,
    LoadFriction as LoadFriction,
    Presliding as Presliding,
    Reversal as Reversal,
    SquareRootFriction as SquareRootFriction,
    StribeckFriction as StribeckFriction,
    Tanh as Tanh,
    TemperatureScaled as TemperatureScaled,
    ViscousFriction as ViscousFriction,
)
from .term import AbstractTerm as AbstractTerm, NonlinearParameter as NonlinearParameter
