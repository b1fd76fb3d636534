"""Former place of `PackedRegressor`."""

from jaxid.dynamics.regressor import PackedRegressor as PackedRegressor
