"""Known properties of a robot: joints, geometry, limits, drives; from URDF, DH or the library."""
