"""Former place of `solve_symmetric`."""

from jaxid.dynamics.dispatch import solve_symmetric as solve_symmetric
