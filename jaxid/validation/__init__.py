"""What a model is worth: torque errors and the definiteness of the mass matrix."""
