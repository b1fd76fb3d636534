"""Physically consistent fits as conic programs, independent of the package."""

import cvxpy as cp
import numpy as np

import jaxid as jid


def problem(
    feasible: jid.consistency.FeasibleSet, data: jid.consistency.ScaledRows
) -> tuple[cp.Problem, cp.Variable, np.ndarray]:
    """Return the fit as a conic program in SI units, its variables and their units."""
    bounds = feasible.bounds
    size = data.A.shape[1]
    norms = np.linalg.norm(data.A, axis=0)
    unit = np.where(
        norms > 0, 10.0 * np.linalg.norm(data.b) / np.where(norms > 0, norms, 1), 0
    )
    for k, columns in enumerate(feasible.bodies):
        L, m = bounds.radius[k], bounds.mass_max[k]
        unit[list(columns)] = (m * L ** np.array([0, 1, 1, 1, 2, 2, 2, 2, 2, 2]))[
            : len(columns)
        ]
    y = cp.Variable(size)
    p = cp.multiply(unit, y)
    constraints = []
    for k, columns in enumerate(feasible.bodies):
        m, h = p[columns[0]], p[list(columns[1:4])]
        A, B, C = (p[j] for j in columns[4:7])
        D, E, F = (p[j] for j in columns[7:]) if len(columns) == 10 else (0.0, 0.0, 0.0)
        L = bounds.radius[k]
        pseudo = cp.bmat(
            [
                [(B + C - A) / 2, F, E, h[0]],
                [F, (A + C - B) / 2, D, h[1]],
                [E, D, (A + B - C) / 2, h[2]],
                [h[0], h[1], h[2], m],
            ]
        )
        shrink = np.diag([1 / L, 1 / L, 1 / L, 1.0]) / np.sqrt(bounds.mass_max[k])
        constraints += [
            shrink @ pseudo @ shrink >> 0,
            m / bounds.mass_max[k] <= 1,
            m >= bounds.mass_min[k],
            L**2 * m >= (A + B + C) / 2,
        ]
    drives = list(feasible.drives)
    constraints += [y[drives] >= 0, y[drives] <= 1]
    for coupling in feasible.couplings:
        parts = [
            p[j] * basis
            for j, basis in zip(coupling.columns, coupling.basis, strict=True)
        ]
        constraints.append(sum(parts[1:], parts[0]) >> 0)
    if bounds.total_mass is not None:
        constraints.append(
            cp.sum(p[[c[0] for c in feasible.bodies]]) == bounds.total_mass
        )
    objective = 0.5 * cp.sum_squares((data.A * unit) @ y - data.b)
    return cp.Problem(cp.Minimize(objective), constraints), y, unit


def optimum(
    feasible: jid.consistency.FeasibleSet, data: jid.consistency.ScaledRows
) -> tuple[float, np.ndarray]:
    """Return the smallest half squares, and the parameters, by CLARABEL."""
    fit, y, unit = problem(feasible, data)
    fit.solve(cp.CLARABEL, tol_gap_abs=1e-9, tol_gap_rel=1e-9, tol_feas=1e-9)
    return float(fit.value), unit * np.asarray(y.value)
