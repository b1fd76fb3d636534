"""The hard case: a KR300 whose motion does not determine all parameters."""

import numpy as np
import pytest

import jaxid as jid

TERMS = (
    jid.RigidBodies(),
    jid.RotorInertia(),
    jid.ViscousFriction(),
    jid.CoulombFriction(),
    jid.ConstantOffset(),
)


@pytest.fixture(scope="module")
def recordings(shared_data):
    columns = jid.Columns("q_mot{}", "tau_motor{}", "dq_mot{}", time="t", forces_on_motor_side=True)
    return [
        jid.observe(
            jid.read_recording(shared_data / "kr300" / f"traj_{name}.csv", columns),
            jid.robots.kr300(),
            jid.ZeroPhaseButterworth(5.0),
        )
        for name in "ABC"
    ]


def test_chosen_on_one_motion_a_ridge_transfers_to_others(recordings):
    base = jid.base_parameters(jid.Model(jid.robots.kr300(), TERMS))
    assert base.size == 58
    identification, *verification = recordings
    plain, ridge = (
        jid.identify(
            base,
            identification,
            jid.WeightedLeastSquares(jid.estimators.ResidualVariances(0), solution),
        )
        for solution in (jid.estimators.Complete(), jid.estimators.CrossValidated())
    )
    assert len(plain.undetermined) >= 5
    named = plain.undetermined[0].sentence(base)
    assert named == "my2 and fo2 cannot be told apart"
    errors = np.array(
        [
            [e.rms_relative.mean() for e in jid.validate(f, verification).errors]
            for f in (plain, ridge)
        ]
    )
    assert (errors[0] > 0.4).all()
    assert (errors[1] < 0.32).all()
