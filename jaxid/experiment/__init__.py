"""The user's experiment file: one TOML file that says robot, model, log and method."""
