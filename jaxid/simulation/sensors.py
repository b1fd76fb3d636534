"""What a robot says of itself: angles in steps of the encoders, torques with noise."""

import equinox as eqx
import numpy as np
from scipy import signal

from jaxid.arrays import AnyArray, Float
from jaxid.measurement.recording import Recording
from jaxid.robot.robot import Robot


class Sensors(eqx.Module):
    """Encoders and torques, as a log has them.

    Attributes:
        encoder_step: Resolution of the logged angles [rad or m].
        white_noise: Standard deviation of the forces' noise without memory, on the joints' side
            [N m or N].
        coloured_noise: Standard deviation of the forces' noise with memory [N m or N].
        memory: Time constant of the coloured noise [s].
        motor_side: Whether the log holds angles and torques of the motors.
    """

    encoder_step: float
    white_noise: Float[AnyArray, " joints"]
    coloured_noise: Float[AnyArray, " joints"]
    memory: float = 0.02
    motor_side: bool = eqx.field(static=True, default=False)

    def resolution(self, robot: Robot) -> Float[np.ndarray, " joints"]:
        """Steps of the encoders on the joints' side [rad or m]."""
        turns = np.abs(np.diag(robot.drives.reduction)) if self.motor_side else 1.0
        return np.broadcast_to(self.encoder_step / turns, robot.joints)

    def record(
        self,
        robot: Robot,
        angles: Float[AnyArray, "samples joints"],
        forces: Float[AnyArray, "samples joints"],
        *,
        sample_time: float,
        seed: int,
        name: str,
    ) -> Recording:
        """Makes a recording of what truly happened.

        Args:
            robot: Whose it is.
            angles: Of the motors, on the joints' side [rad or m].
            forces: Of the drives, on the joints' side [N m or N].
            sample_time: Time between two samples [s].
            seed: Of the noise.
            name: Of the recording.
        """
        random = np.random.default_rng(seed)
        angles, forces = np.asarray(angles), np.asarray(forces)
        white, drive = random.standard_normal((2, *forces.shape))
        kept = np.exp(-sample_time / self.memory)
        warm = random.standard_normal((1, forces.shape[1]))
        coloured, _ = signal.lfilter(
            [np.sqrt(1.0 - kept**2)], [1.0, -kept], drive, axis=0, zi=kept * warm
        )
        forces = forces + white * np.asarray(self.white_noise)
        forces = forces + coloured * np.asarray(self.coloured_noise)
        if self.motor_side:
            angles = np.asarray(robot.drives.motor_angles(angles))
            forces = np.asarray(robot.drives.motor_torques(forces))
        return Recording.of(
            self.encoder_step * np.round(angles / self.encoder_step),
            forces,
            sample_time=sample_time,
            angles_on_motor_side=self.motor_side,
            forces_on_motor_side=self.motor_side,
            name=name,
        )
