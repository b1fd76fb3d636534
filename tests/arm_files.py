"""URDF files of arms without masses, for tests of experiment files."""

HALF_PI = 1.5707963267948966


def urdf_of_arm(*origins):
    """Return the file of an arm whose joints turn about z, one for each origin.

    An origin is the position of the joint [m], and the angle about x by which its frame
    is turned against the one before [rad].
    """
    parts = ['<robot name="arm"><link name="link0"/>']
    for k, (x, y, z, roll) in enumerate(origins, 1):
        parts.append(
            f'<link name="link{k}"/><joint name="joint{k}" type="continuous">'
            f'<parent link="link{k - 1}"/><child link="link{k}"/>'
            f'<origin xyz="{x} {y} {z}" rpy="{roll} 0 0"/><axis xyz="0 0 1"/></joint>'
        )
    return "\n".join([*parts, "</robot>"])
