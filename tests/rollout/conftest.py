import pytest

pytest.importorskip("mujoco", reason="MuJoCo is not installed (extra `mujoco`)")

import servo_arm

import jaxid as jid


@pytest.fixture(scope="session")
def fit():
    logs = [servo_arm.log(seed) for seed in range(4)]
    return jid.identify_rollout(logs, servo_arm.bodies(False))
