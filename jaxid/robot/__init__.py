"""Known properties of a robot, from URDF, MJCF, DH or the library."""
