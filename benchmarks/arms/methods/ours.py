"""This package, as its users run it."""

import dataclasses

import numpy as np
from arm import Result


def _identify(arm, setup, columns):
    """Identify from the logs, and return the result."""
    import jaxid as jid

    report = jid.identify_logs(setup, arm.logs, columns)
    fit = report.fit

    def forces(q, qd, qdd):
        return np.asarray(fit.predict(jid.Motion(q, qd, qdd)))

    robot = setup.robot
    bodies = None
    if fit.full_parameters is not None:
        bodies = np.asarray(fit.full_parameters)[: 10 * robot.bodies].reshape(-1, 10)
    return Result(forces, bodies)


def default(arm):
    """`jaxid identify` with the defaults of a new experiment file."""
    content = arm.experiment()
    return _identify(arm, content.setup, content.columns)


def choice(arm):
    """`jaxid choose`, then `jaxid identify` with the file that it writes."""
    import jaxid as jid

    found = jid.experiment.choose_model(arm.experiment(), arm.logs)
    content = arm._replace(text=found.text).experiment()
    return _identify(arm, content.setup, content.columns)


def _with_estimator(arm, estimator):
    content = arm.experiment()
    setup = dataclasses.replace(content.setup, estimator=estimator)
    return _identify(arm, setup, content.columns)


def least_squares(arm):
    """Ordinary least squares."""
    import jaxid as jid

    return _with_estimator(arm, jid.estimators.LeastSquares())


def weighted(arm):
    """Least squares weighted by the residuals of each joint."""
    import jaxid as jid

    return _with_estimator(arm, jid.WeightedLeastSquares())


KIND = "torques"
METHODS = {
    "jaxid": default,
    "jaxid choose": choice,
    "jaxid, least squares": least_squares,
    "jaxid, weighted": weighted,
}
