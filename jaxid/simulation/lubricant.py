"""How warm the gears are, and what that does to their friction (Sec. 6)."""

import equinox as eqx
import numpy as np

from jaxid.arrays import AnyArray, Float


class Lubricant(eqx.Module):
    r"""Friction falls exponentially with temperature, and heats the gear.

    Viscous friction is multiplied with $e^{-a (T - T_0)}$, the law of `TemperatureScaled`, dry
    friction likewise with a rate of its own. The heat stays in the gear for a while:
    $t_h \dot T = R P - (T - T_a)$ with the friction's power $P$.

    Attributes:
        viscous_rate: $a$ of the viscous friction [1/K].
        dry_rate: $a$ of the dry friction [1/K].
        resistance: $R$ from each gear to the air [K/W].
        time: $t_h$ [s].
        reference: Temperature $T_0$ at which the friction is known [°C].
        ambient: Temperature $T_a$ of the air [°C].
    """

    viscous_rate: Float[AnyArray, " joints"]
    dry_rate: Float[AnyArray, " joints"]
    resistance: Float[AnyArray, " joints"]
    time: float = 600.0
    reference: float = 20.0
    ambient: float = 20.0

    def factors(
        self, temperature: Float[AnyArray, "*batch joints"]
    ) -> tuple[Float[np.ndarray, "*batch joints"], Float[np.ndarray, "*batch joints"]]:
        """By what viscous and dry friction are multiplied at a temperature [°C]."""
        warmer = np.asarray(temperature) - self.reference
        return np.exp(-self.viscous_rate * warmer), np.exp(-self.dry_rate * warmer)

    def warmer(
        self,
        temperature: Float[AnyArray, " joints"],
        power: Float[AnyArray, " joints"],
        duration: float,
    ) -> Float[np.ndarray, " joints"]:
        """Temperatures after some time with friction of constant power [°C].

        Args:
            temperature: At the start [°C].
            power: Of the friction [W].
            duration: How long [s].
        """
        final = self.ambient + np.asarray(self.resistance) * np.asarray(power)
        return final + (np.asarray(temperature) - final) * np.exp(-duration / self.time)
