"""Little URDF files as text."""


def numbers(values):
    return " ".join(repr(float(v)) for v in values)


def link(name, inertial=""):
    return f'<link name="{name}">{inertial}</link>'


def inertial(mass, xyz, rpy, inertia):
    ixx, ixy, ixz, iyy, iyz, izz = inertia
    return (
        f'<inertial><origin xyz="{numbers(xyz)}" rpy="{numbers(rpy)}"/>'
        f'<mass value="{mass}"/><inertia ixx="{ixx}" ixy="{ixy}" ixz="{ixz}" '
        f'iyy="{iyy}" iyz="{iyz}" izz="{izz}"/></inertial>'
    )


def joint(
    name,
    parent,
    child,
    kind="revolute",
    *,
    xyz="0 0 0",
    rpy="0 0 0",
    axis="0 0 1",
    inner="",
):
    return (
        f'<joint name="{name}" type="{kind}"><origin xyz="{xyz}" rpy="{rpy}"/>'
        f'<parent link="{parent}"/><child link="{child}"/>'
        f'<axis xyz="{axis}"/>{inner}</joint>'
    )


def robot(*parts):
    return (
        '<?xml version="1.0"?>\n<robot name="arm">\n'
        + "\n".join(parts)
        + "\n</robot>\n"
    )


def arm(**options):
    """One joint, `j1`, between the links `base` and `a`."""
    return robot(link("base"), link("a"), joint("j1", "base", "a", **options))
