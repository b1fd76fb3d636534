"""Former name of `JointRegressor`."""

from jaxid.dynamics.regressor import JointRegressor as JointRows  # noqa: F401
