"""What the operator must give, by definition, in plain NumPy: no code is shared with `microid`."""

import numpy as np


def interpolated(nodes_um_per_V2, lower_V, upper_V, alpha_V, beta_V):
    """Bilinear in the squares between the nodes, linear on the triangles along the diagonal."""
    n = len(nodes_um_per_V2) - 1
    x, y = (n * (v - lower_V) / (upper_V - lower_V) for v in np.broadcast_arrays(alpha_V, beta_V))
    i, j = (np.clip(np.floor(v).astype(int), 0, n - 1) for v in (x, y))
    s, t = x - i, y - j
    here, right, across = nodes_um_per_V2[i, j], nodes_um_per_V2[i + 1, j], nodes_um_per_V2[i + 1, j + 1]
    triangle = (1 - s) * here + (s - t) * right + t * across
    above = nodes_um_per_V2[i, np.minimum(j + 1, n)]
    square = (1 - s) * (1 - t) * here + s * (1 - t) * right + (1 - s) * t * above + s * t * across
    inside = (alpha_V >= beta_V) & (alpha_V <= upper_V) & (beta_V >= lower_V)
    return np.where(inside, np.where(i == j, triangle, square), 0)


def relay_weights_um(density, slope, lower_V, upper_V, relays):
    """Weights of N by N relays, shape (N, N), and their thresholds, the centres of cells, shape (N,).

    One point per cell, its centroid: exact where the density is bilinear on a square, linear on a triangle. The
    slope of the reversible part goes to the relays on the diagonal, which have no memory.
    """
    cell_V = (upper_V - lower_V) / relays
    middle_V = lower_V + (np.arange(relays) + 0.5) * cell_V
    weights = np.tril(density(middle_V[:, None], middle_V) * cell_V**2, -1)
    triangles = density(middle_V + cell_V / 6, middle_V - cell_V / 6) * cell_V**2 / 2
    return weights + np.diag(triangles + slope(middle_V) * cell_V), middle_V


def play_relays(weights_um, thresholds_V, voltage_V, before_V=()):
    """Look at every relay for every sample: on once the voltage reaches alpha, off once it is below beta."""
    on = np.zeros(weights_um.shape, dtype=bool)
    displacement_um = []
    for voltage in np.concatenate([before_V, voltage_V]):
        on[thresholds_V <= voltage] = True
        on[:, thresholds_V > voltage] = False
        displacement_um.append(np.sum(weights_um, where=on))
    return np.array(displacement_um[len(before_V) :])


def branches(path):
    """Anchor and direction of every entry of a path that stays at or above its first, in O(n**2)."""
    anchors, rising = [0], [True]
    for t in range(1, len(path)):
        x = path[t]
        up = rising[-1] if x == path[t - 1] else bool(x > path[t - 1])
        beyond = [k for k in range(t) if (path[k] > x if up else path[k] < x)]
        since = range(beyond[-1] + 1 if beyond else 0, t)
        anchors.append((min if up else max)(since, key=lambda k: path[k]))
        rising.append(up)
    return np.array(anchors), np.array(rising)


def reduced(path):
    """Follow the anchors back from the end: the remembered extremes, oldest first, the present voltage last."""
    anchors, _ = branches(path)
    t, extremes = len(path) - 1, [path[-1]]
    while t > 0:
        t = anchors[t]
        extremes.append(path[t])
    return np.array(extremes[::-1])


def forest_totals(step, anchor):
    """Every entry adds to the total of its anchor, one after the other."""
    total = np.array(step, dtype=float)
    for t in range(1, len(total)):
        total[t] = total[t] + total[anchor[t]]
    return total


def central_differences(function, x, step):
    """Jacobian of a function of a vector, column by column; `step` has the shape of `x`."""
    columns = []
    for k, h in enumerate(step):
        move = np.zeros_like(x)
        move[k] = h
        columns.append((np.asarray(function(x + move)) - np.asarray(function(x - move))) / (2 * h))
    return np.stack(columns, axis=-1)


def invert_relays(weights_um, thresholds_V, reference_um):
    """Find voltages by bisection, looking at every relay: the lowest at which the output reaches the reference."""
    on = np.zeros(weights_um.shape, dtype=bool)
    cell_V = thresholds_V[1] - thresholds_V[0]

    def after(count):
        new = on.copy()
        new[:count] = True
        new[:, count:] = False
        return new

    voltage_V = []
    for wanted in reference_um:
        few, many = 0, len(thresholds_V)
        while few < many:
            middle = (few + many) // 2
            if np.sum(weights_um, where=after(middle)) < wanted:
                few = middle + 1
            else:
                many = middle
        on = after(few)
        voltage_V.append(thresholds_V[0] + (few - 0.5) * cell_V)
    return np.array(voltage_V)
