"""Gains of the stage in plain NumPy, from compliances of half a leg; shares nothing with `microid`."""

import numpy as np

ARGUMENTS = {
    "x": ["l1", "t1", "la1", "l2", "t2", "l3", "alpha1"],
    "z": ["la2", "alpha2", "t4"],
    "alpha": ["l", "l5", "la2", "alpha2", "t4"],
    "gamma": ["l6", "t6", "la3", "l7", "t7", "alpha3", "J", "R"],
}
TWINS = {"x": "x", "y": "x", "z": "z", "alpha": "alpha", "beta": "alpha", "gamma": "gamma"}
TABLE_1 = {
    "l1": 7.0, "t1": 0.8, "la1": 9.0, "alpha1": 0.068, "l2": 10.0, "t2": 1.0, "l3": 28.0,
    "l4": 9.0, "t4": 0.8, "la2": 9.0, "alpha2": 0.061, "l5": 9.0, "t5": 0.8, "h": 5.0, "d": 10.0, "l": 40.0,
    "l6": 2.0, "t6": 0.8, "la3": 14.0, "alpha3": 0.185, "l7": 2.0, "t7": 0.8, "R": 4.0, "J": 4.0,
}  # fmt: skip


def sizes(**changed):
    return TABLE_1 | changed


def leaf(length, thickness, level):
    axial = (length + 2.18 * level * thickness) / thickness
    turn = 12 * (length + 0.8 * level * thickness) / thickness**3
    return axial, turn, ((length + 0.8 * level * thickness) / thickness) ** 3 + _shear(level) * length / thickness


def _shear(level):
    return level * 2 * 1.29 * 6 / 5


def leg(length, thickness, distance, angle, height, level):
    """Compliance matrix of two leaves and a link, ends guided, as xx, xy and yy."""
    axial, turn, lateral = leaf(length, thickness, level)
    along, across = distance * np.cos(angle), distance * np.sin(angle)
    slender = level * (along - length) / height
    return (
        2 * axial + turn * across**2 / 2 + slender,
        turn * along * across / 2,
        2 * lateral + turn * along**2 / 2 + slender**3 + _shear(level) * slender,
    )


def gains(axis, d, level=1, guides=4.0, piezo=None):
    """Output per elongation in um, or with the stiffness of a piezo in N/um per free elongation."""
    scale = 206.0 * d["d"]
    if axis in ("x", "y"):
        xx, xy, yy = leg(d["l1"], d["t1"], d["la1"], d["alpha1"], d["h"], level)
        load = guides / leg(d["l2"], d["t2"], d["l3"], 0.0, d["h"], level)[2]
        give, arm = 1.0, 1.0
    elif axis == "gamma":
        xx, xy, yy = leg(d["l6"], d["t6"], d["la3"], d["alpha3"], d["h"], level)
        axial, turn, lateral = leaf(d["l7"], d["t7"], level)
        arm = d["R"] + d["J"]
        spring = (1 / turn + d["l7"] ** 2 / lateral / 4) / arm**2
        give = 1 + spring * axial
        load, arm = spring / give, 1e3 * arm
    else:
        xx, xy, yy = leg(d["l4"], d["t4"], d["la2"], d["alpha2"], d["h"], level)
        load, give, arm = 0.0, 1.0, 1.0
        if axis != "z":
            arm = 1e3 * 4 / 3 * (3 * d["l"] ** 2 + 3 * d["l"] * d["l5"] + d["l5"] ** 2) / (2 * d["l"] + d["l5"])
    loose = xx * yy - xy**2
    # Output over input, with the load's spring in parallel to the leg's own.
    found = xy / (xx + load * loose) / give / arm
    if piezo is None:
        return found
    stiffness = scale * (yy - xy**2 / (xx + load * loose)) / loose
    return found * piezo / (piezo + stiffness)


def slopes(axis, d, names, **options):
    """Gradient by complex steps."""
    return np.array([gains(axis, d | {n: d[n] + 1e-30j}, **options).imag / 1e-30 for n in names])


def curvatures(axis, d, names, **options):
    """Hessian by central differences of complex steps."""
    rows = []
    for n in names:
        step = 1e-5 * d[n]
        up, down = (slopes(axis, d | {n: d[n] + s}, names, **options) for s in (step, -step))
        rows.append((up - down) / (2 * step))
    return np.array(rows)
