"""Plane frames of elastic leaves between rigid bodies, in NumPy and SciPy: no code is shared with `microid`.

Units inside: mm, N, MPa, rad. Every rigid part is one body with three coordinates, so that rigidity is exact.
"""

import numpy as np
from scipy.linalg import null_space

X, Y, TURN = np.eye(3)


class Frame:
    """Leaves between rigid bodies; body 0 is the ground, once it is held."""

    def __init__(self, modulus_MPa=206e3, width_mm=10.0, shear=0.0, pieces=1):
        """`shear`: Young's modulus over the effective shear modulus, 0 for Euler-Bernoulli; `pieces`: per leaf."""
        self.modulus, self.width, self.shear, self.pieces = modulus_MPa, width_mm, shear, pieces
        self.places, self.beams = [], []
        self.ground = self.body((0.0, 0.0))

    def body(self, place):
        """A new rigid body, or a node, whose coordinates are the motion of this place and its rotation."""
        self.places.append(np.asarray(place, dtype=float))
        return len(self.places) - 1

    def leaf(self, first, start, second, end, thickness):
        """A leaf from the point `start` of one body to the point `end` of another."""
        points = np.linspace(start, end, self.pieces + 1)
        chain = [first, *(self.body(p) for p in points[1:-1]), second]
        for k in range(self.pieces):
            self.beams.append((chain[k], points[k], chain[k + 1], points[k + 1], thickness))

    def lever(self, body, place):
        """Motion of a point of a body from the body's coordinates, shape `(3, 3)`."""
        dx, dy = place - self.places[body]
        return np.array([[1, 0, -dy], [0, 1, dx], [0, 0, 1]])

    def point(self, body, place):
        """Motion of a point of a body from all coordinates, shape `(3, n)`."""
        rows = np.zeros((3, 3 * len(self.places)))
        rows[:, 3 * body : 3 * body + 3] = self.lever(body, place)
        return rows

    def motion(self, body, direction):
        """The row that takes all coordinates to one component of a body's motion."""
        return direction @ self.point(body, self.places[body])

    def held(self, body, directions=(X, Y, TURN)):
        return [self.motion(body, d) for d in directions]

    def stiffness(self):
        """The assembled matrix of all coordinates, before anything is held."""
        size = 3 * len(self.places)
        total = np.zeros((size, size))
        for first, start, second, end, thickness in self.beams:
            ends = np.zeros((6, 6))
            ends[:3, :3], ends[3:, 3:] = self.lever(first, start), self.lever(second, end)
            at = [3 * body + k for body in (first, second) for k in range(3)]
            matrix = beam(start, end, thickness, self.modulus, self.width, self.shear)
            total[np.ix_(at, at)] += ends.T @ matrix @ ends
        return total

    def imposed(self, still, moved):
        """Motions of all coordinates, one column for each row of `moved` at 1 with the others and `still` at 0."""
        return self.response(still, moved)[0]

    def ports(self, still, moved):
        """Stiffness seen at the rows of `moved`, in N/mm or N mm."""
        return self.response(still, moved)[1]

    def response(self, still, moved):
        rows = np.array([*moved, *still])
        some = np.linalg.pinv(rows)[:, : len(moved)]
        free = null_space(rows)
        stiffness = self.stiffness()
        u = some - free @ np.linalg.solve(free.T @ stiffness @ free, free.T @ stiffness @ some)
        return u, u.T @ stiffness @ u


def beam(start, end, thickness, modulus, width, shear):
    """Stiffness of a Timoshenko beam in the plane, exact for loads at its ends: `x, y, turn` of either end."""
    length = np.hypot(*(end - start))
    cosine, sine = (end - start) / length
    axial = modulus * width * thickness / length
    bending = modulus * width * thickness**3 / 12 / length
    softness = shear * thickness**2 / length**2
    k, near, far = bending / (1 + softness), 4 + softness, 2 - softness
    a, b = 12 * k / length**2, 6 * k / length
    local = np.array(
        [
            [axial, 0, 0, -axial, 0, 0],
            [0, a, b, 0, -a, b],
            [0, b, near * k, 0, -b, far * k],
            [-axial, 0, 0, axial, 0, 0],
            [0, -a, -b, 0, a, -b],
            [0, b, far * k, 0, -b, near * k],
        ]
    )
    turn = np.zeros((6, 6))
    turn[:3, :3] = turn[3:, 3:] = [[cosine, sine, 0], [-sine, cosine, 0], [0, 0, 1]]
    return turn.T @ local @ turn


class Bridge:
    """A bridge amplifier of four legs in a frame: its output block at `place`, its fixed one behind.

    The input axis is x and the output moves against y, unless `angle` turns the whole.
    """

    def __init__(self, frame, length, thickness, leg, inclination, place=(0.0, 0.0), angle=0.0):
        run, rise = leg * np.cos(inclination), leg * np.sin(inclination)
        half_block, half_gap = 3.0, 4.0
        turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
        self.inward, self.across = np.append(turn @ [0, -1], 0), np.append(turn @ [1, 0], 0)

        def at(x, y):
            """Bridge's axes, from its centre, to the frame's."""
            return np.asarray(place) + turn @ [x, y - half_gap - rise]

        self.frame = frame
        self.output = frame.body(at(0, half_gap + rise))
        self.inputs = [frame.body(at(side * (half_block + run + length), 0)) for side in (1, -1)]
        for block, up in ((self.output, 1), (frame.ground, -1)):
            for entry, side in zip(self.inputs, (1, -1), strict=True):
                inner, outer = side * half_block, side * (half_block + run)
                high, low = up * (half_gap + rise), up * half_gap
                insert = frame.body(at(inner + side * length, high))
                frame.leaf(block, at(inner, high), insert, at(inner + side * length, high), thickness)
                frame.leaf(insert, at(outer, low), entry, at(outer + side * length, low), thickness)

    def elongation(self):
        """The row of the distance between the input blocks."""
        return self.frame.motion(self.inputs[0], self.across) - self.frame.motion(self.inputs[1], self.across)

    def displacement(self):
        """The row of the output, towards the bridge's centre."""
        return self.frame.motion(self.output, self.inward)


def numbered(dimensions, hinge, leg):
    """Length, thickness, distance and inclination of the bridge with these numbers in Table 1."""
    return (dimensions[f"l{hinge}"], dimensions[f"t{hinge}"], dimensions[f"la{leg}"], dimensions[f"alpha{leg}"])


def translation(dimensions, hinge, leg, guides=0, **frame):
    """A bridge that moves a stage on guiding legs: frame, bridge and what is held."""
    f = Frame(**frame)
    bridge = Bridge(f, *numbered(dimensions, hinge, leg))
    if guides % 2:
        raise ValueError("guiding legs come in pairs, one on either side")
    for k in range(guides):
        side, level = (-1) ** k, 5.0 + 15.0 * (k // 2)
        length, thickness, distance = dimensions["l2"], dimensions["t2"], dimensions["l3"]
        near, far = [10 * side, level], [side * (10 + distance), level]
        bar = f.body(near)
        f.leaf(bridge.output, near, bar, [near[0] + side * length, level], thickness)
        f.leaf(bar, far, f.ground, [far[0] + side * length, level], thickness)
    return f, bridge, f.held(f.ground)


def tilt_rad_per_mm(dimensions, **frame):
    """A platform between two leaves, one of them lifted by its block, the other's block at rest."""
    f = Frame(**frame)
    half, length = dimensions["l"], dimensions["l5"]
    platform = f.body([0.0, 0.0])
    lifted = f.body([half + length, 0.0])
    for side, block in ((1, lifted), (-1, f.ground)):
        f.leaf(platform, [side * half, 0.0], block, [side * (half + length), 0.0], dimensions["t5"])
    still = [*f.held(f.ground), *f.held(lifted, (X, TURN))]
    return (f.motion(platform, TURN) @ f.imposed(still, [f.motion(lifted, Y)])).item()


def rotor(dimensions, **frame):
    """Two bridges that turn a rotor as a couple: frame, rotor, bridges and what is held.

    The output blocks are guided: they move along their axes only. Nothing but its leaves holds the rotor; its centre
    stays because the frame is symmetric about it.
    """
    f = Frame(**frame)
    arm, length, thickness = dimensions["R"] + dimensions["J"], dimensions["l7"], dimensions["t7"]
    centre = f.body([0.0, 0.0])
    bridges = []
    for sign, angle in ((1, 0.0), (-1, np.pi)):
        tip, foot = sign * np.array([-arm, 0.0]), sign * np.array([-arm, -length])
        bridge = Bridge(f, *numbered(dimensions, 6, 3), place=foot, angle=angle)
        f.leaf(bridge.output, foot, centre, tip, thickness)
        bridges.append(bridge)
    still = f.held(f.ground)
    for bridge in bridges:
        still += f.held(bridge.output, (bridge.across, TURN))
    return f, centre, bridges, still


def amplifier(axis, dimensions, guides=4, **frame):
    """The bridge of any axis but gamma: under its guiding legs in x and y, without a load otherwise."""
    if axis in ("x", "y"):
        return translation(dimensions, 1, 1, guides, **frame)
    return translation(dimensions, 4, 2, **frame)


def gain(axis, dimensions, guides=4, **frame):
    """Output per elongation of the piezo, small strokes: um/um, or rad/um for rotations."""
    return gain_and_input_stiffness(axis, dimensions, guides, **frame)[0]


def input_stiffness_N_per_um(axis, dimensions, guides=4, **frame):
    """Force over elongation of one piezo; in gamma both bridges are driven alike."""
    return gain_and_input_stiffness(axis, dimensions, guides, **frame)[1]


def gain_and_input_stiffness(axis, dimensions, guides=4, **frame):
    """Both from one solution."""
    if axis == "gamma":
        f, centre, bridges, still = rotor(dimensions, **frame)
        u, ports = f.response(still, [bridge.elongation() for bridge in bridges])
        return (f.motion(centre, TURN) @ u).sum() / 1000, ports[0].sum() / 1000
    f, bridge, still = amplifier(axis, dimensions, guides, **frame)
    u, port = f.response(still, [bridge.elongation()])
    ratio = (bridge.displacement() @ u).item()
    tilt = tilt_rad_per_mm(dimensions, **frame) / 1000 if axis in ("alpha", "beta") else 1
    return ratio * tilt, port.item() / 1000


def two_port_N_per_um(length, thickness, leg, inclination, **frame):
    """Stiffness of one bridge at its elongation and its output, towards its centre, shape `(2, 2)`."""
    f = Frame(**frame)
    bridge = Bridge(f, length, thickness, leg, inclination)
    return f.ports(f.held(f.ground), [bridge.elongation(), bridge.displacement()]) / 1000


def random_dimensions(rng):
    """Names of Table 1 and sizes in mm or rad, drawn over what can be built, never the paper's own."""
    d = {f"t{k}": rng.uniform(0.4, 1.2) for k in (1, 2, 4, 5, 6, 7)}
    d |= {f"l{k}": rng.uniform(2.0, 9.0) for k in (1, 2, 4, 5, 6, 7)}
    d |= {f"alpha{k}": rng.uniform(0.03, 0.2) for k in (1, 2, 3)}
    for leg, hinge in ((1, 1), (2, 4), (3, 6)):
        d[f"la{leg}"] = (d[f"l{hinge}"] + rng.uniform(0.5, 10.0)) / np.cos(d[f"alpha{leg}"])
    d |= {"l3": d["l2"] + rng.uniform(2.0, 25.0), "l": rng.uniform(15.0, 80.0)}
    return d | {"R": rng.uniform(2.0, 8.0), "J": rng.uniform(2.0, 8.0)}
