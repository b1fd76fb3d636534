"""Terms of a model: effects that are linear in unknown parameters."""

from .drives_and_springs import (
    ConstantOffset as ConstantOffset,
    CoupledDrives as CoupledDrives,
    LinearSpring as LinearSpring,
    RotorInertia as RotorInertia,
    TorqueRipple as TorqueRipple,
)
from .dry_friction_transitions import (
    AbstractTransition as AbstractTransition,
    HardSign as HardSign,
    Presliding as Presliding,
    Reversal as Reversal,
    Tanh as Tanh,
)
from .force_sensors import (
    SensorBias as SensorBias,
    SensorRotation as SensorRotation,
)
from .friction import (
    AsymmetricCoulombFriction as AsymmetricCoulombFriction,
    AsymmetricViscousFriction as AsymmetricViscousFriction,
    CoulombFriction as CoulombFriction,
    LoadFriction as LoadFriction,
    PassiveFriction as PassiveFriction,
    SquareRootFriction as SquareRootFriction,
    StribeckFriction as StribeckFriction,
    TemperatureScaled as TemperatureScaled,
    ViscousFriction as ViscousFriction,
)
from .rigid_bodies import RigidBodies as RigidBodies, SensorLoad as SensorLoad
from .term import (
    AbstractTerm as AbstractTerm,
    JointParameter as JointParameter,
)

TERMS: dict[str, type[AbstractTerm]] = {
    "bodies": RigidBodies,
    "viscous": ViscousFriction,
    "viscous_asymmetric": AsymmetricViscousFriction,
    "coulomb": CoulombFriction,
    "coulomb_asymmetric": AsymmetricCoulombFriction,
    "stribeck": StribeckFriction,
    "square_root": SquareRootFriction,
    "load": LoadFriction,
    "rotor_inertia": RotorInertia,
    "ripple": TorqueRipple,
    "offset": ConstantOffset,
    "coupled_drives": CoupledDrives,
    "springs": LinearSpring,
    "passive_friction": PassiveFriction,
    "temperature": TemperatureScaled,
    "sensor_load": SensorLoad,
    "sensor_bias": SensorBias,
    "sensor_rotation": SensorRotation,
}
"""All terms by name, in the order in which a model of an experiment file has them."""
