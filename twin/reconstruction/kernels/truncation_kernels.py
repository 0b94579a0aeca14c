"""An elliptic prism: its path lengths beyond a panel's edges, and its fit to the views.

Rows are continued on all cores, in one pass over the pixels, for the processor and for a device
alike: of 360 views into 512^3 a device takes milliseconds a view, this a fraction of one, and
what it writes is what has to be copied there anyway.

The fit is Levenberg and Marquardt's, of six numbers, with normal equations of six rows that are
solved here: BLAS would start a thread on each core for each step. Arguments are not checked.
"""

from __future__ import annotations

import math

import numpy as np
from numba import prange

from flexdt.twin.projection.kernels.compiling import kernel, parallel, serial

PARAMETERS = 6
MAX_STEPS = 100
"""Largest number of evaluations of a fit: usually a dozen is enough."""
MIN_GAIN = 1e-10
"""Relative fall of the cost below which a fit ends."""
FIRST_DAMPING = 1.0
LEAST_DAMPING = 1e-9
MOST_DAMPING = 1e9
MIN_CHORD_SHARE = 1e-3
"""Share of the longest chord, squared, below which its slope is limited: at the rim
itself it is infinite."""


@kernel
def _chord(prism, source_x, source_y, x, y):
    """Compute path length times attenuation through a prism, over the ray's horizontal length; 0
    for a ray that misses it.

    `prism`: (6,) center x, y; lower triangle (0, 0), (1, 0), (1, 1) to the unit disc;
    attenuation. `source_x`: [mm]. `source_y`: [mm]. `x`: horizontal direction of the ray, of any
    length. `y`: likewise.
    """
    # In the frame where the ellipse is the unit disc, a ray p + t d is inside for 2
    # sqrt(|d|^2 - (p x d)^2) / |d|^2 of t. The cross product there is the one here times the
    # map's determinant.
    start_x = source_x - prism[0]
    start_y = source_y - prism[1]
    along_x = prism[2] * x
    along_y = prism[3] * x + prism[4] * y
    squared = along_x * along_x + along_y * along_y
    apart = prism[2] * prism[4] * (start_x * y - start_y * x)
    inside = squared - apart * apart
    if inside <= 0.0:
        return 0.0
    return 2.0 * prism[5] * math.sqrt(inside) / squared


@kernel
def _edge_mean(line, before, first, last, lower, upper, share, across, high):
    """Average a row less the prisms' path lengths over columns first <= c < last of the
    panel; 0 without columns.

    The lengths are those of both bands, interpolated by `share`, times the root of
    `across` + `high`.

    Args:
        line: the panel's row.
        before: columns before it among the widened ones.
        first: first column.
        last: column after the last.
        lower: (wide,) prisms' lengths of the row's lower band.
        upper: (wide,) of its upper band.
        share: how much the upper one counts.
        across: (wide,) squares of the ray's horizontal part.
        high: square of its vertical part.
    """
    total = 0.0
    for c in range(first, last):
        at = before + c
        # The prisms are upright: all rays above one another are inside for the same t, and
        # the whole length of a ray, its rise included, makes that a path.
        model = lower[at] + share * (upper[at] - lower[at])
        total += line[c] - model * math.sqrt(across[at] + high)
    # An edge of no columns leaves no rest, rather than 0 / 0.
    return total / max(last - first, 1)


@kernel
def _continue_side(
    out, near, lower, upper, share, across, high, rest, fade, factors, weighed
):
    """Fill the columns of a row on one side of the panel: the prisms, and the rest at the edge
    fading out, times the columns' factors over the rays' lengths, if these are wanted.

    All arrays are of these columns.

    `out`: filled. `near`: first column in which some of the rest is left, and the one after the
    last; used for weighed rows only. `lower` and `upper`: prisms' lengths of the row's two
    bands. `share`: how much the upper band counts. `across`: squares of the ray's horizontal
    part. `high`: square of its vertical part. `rest`: residual of the prisms at the panel's
    edge. `fade`: part of it that is left in each column. `factors`: of the columns, used for
    weighed rows only. `weighed`: multiply by factors over the rays' lengths.
    """
    # Counted from 0, an index needs no check for a negative one, and loops are vectorised.
    if not weighed:
        for c in range(len(out)):
            model = lower[c] + share * (upper[c] - lower[c])
            out[c] = np.float32(model * math.sqrt(across[c] + high) + rest * fade[c])
        return
    # The weight is a factor over the ray's length, and a path has that length as a factor:
    # both cancel, and only columns with a rest need a root.
    part = np.float32(share)
    for c in range(len(out)):
        out[c] = (lower[c] + part * (upper[c] - lower[c])) * factors[c]
    _add_rest(
        out[near[0] : near[1]],
        np.float32(rest),
        fade[near[0] : near[1]],
        across[near[0] : near[1]],
        high,
        factors[near[0] : near[1]],
    )


@kernel
def _add_rest(out, rest, fade, across, high, factors):
    """Add the weighed rest at the edge to columns; arguments as those of `_continue_side`."""
    for c in range(len(out)):
        out[c] += rest * fade[c] * factors[c] / math.sqrt(across[c] + high)


@kernel
def _weigh_line(out, line, across, high, factors):
    """Weigh a row of the panel; arguments as those of `_continue_side`."""
    for c in range(len(out)):
        out[c] = line[c] * factors[c] / math.sqrt(across[c] + high)


@parallel
def prism_lengths(before, cols, edge, plane, prisms, out):
    """Compute the horizontal path lengths times attenuation of prisms beyond a panel's
    edges.

    Args:
        before, cols: columns before the panel's first, and of the panel.
        edge: columns at an edge whose mean is continued.
        plane: (n, 6) source, ray to the first column of `out`, and step from column to
            column, x and y [mm].
        prisms: (k, 6) of `_chord`; those without attenuation give 0.
        out: float32 (n, k, wide), filled, over the horizontal length of the ray [1/mm]; 0
            in columns of the panel that are not at an edge.
    """
    n, bands, wide = out.shape
    after = before + cols
    for job in prange(n * bands):
        view = job // bands
        k = job % bands
        g = plane[view]
        for c in range(wide):
            # On the panel only the columns whose rest is averaged need a path.
            length = 0.0
            if prisms[k, 5] > 0.0 and (c < before + edge or c >= after - edge):
                length = _chord(prisms[k], g[0], g[1], g[2] + c * g[4], g[3] + c * g[5])
            out[view, k, c] = np.float32(length)


@parallel
def continue_rows(
    images, first, before, edge, lengths, band, share, cut, fade, across, up, factors, out
):
    """Continue rows beyond the panel's edges; with factors, weigh them in the same pass.

    Beside the panel a row is the prisms' path length and the mean residual at its edge,
    which fades out.

    Args:
        images: float32 (n, rows of the panel, cols).
        first: row of the panel that is the first of `out`; rows beyond it repeat its
            outermost ones.
        before: columns of `out` before the panel's first.
        edge: columns at an edge whose mean is continued; 0 for no residual.
        lengths: (n, bands, wide) of `prism_lengths`.
        band, share: (rows,) lower band of each row, and how much the next one counts.
        cut: (rows,) share of the prisms' residual at the edges that is continued.
        fade: float32 (wide,) part of it that is left in each column.
        across, up: squares of the ray's horizontal and vertical parts, float32 (n, wide)
            and (n, rows) [mm^2].
        factors: (n, wide) that rows are multiplied by, over the rays' lengths, as
            `fdk_kernels.weigh` does; (n, 0) for rows as they are.
        out: float32 (n, rows, wide or more), filled; 0 in columns after these.
    """
    n, rows, padded = out.shape
    wide = across.shape[1]
    cols = images.shape[2]
    after = before + cols
    bands = lengths.shape[1]
    # The rest fades alike in all rows: columns where nothing is left of it are found once.
    begin = 0
    while begin < before and fade[begin] == 0.0:
        begin += 1
    end = wide
    while end > after and fade[end - 1] == 0.0:
        end -= 1
    for job in prange(n * rows):
        view = job // rows
        r = job % rows
        line = images[view, min(max(first + r, 0), images.shape[1] - 1)]
        lower = lengths[view, band[r]]
        upper = lengths[view, min(band[r] + 1, bands - 1)]
        flat = across[view]
        high = np.float32(up[view, r])
        part = share[r]
        other = cols - edge
        low = _edge_mean(line, before, np.int64(0), edge, lower, upper, part, flat, high)
        top = _edge_mean(line, before, other, cols, lower, upper, part, flat, high)
        row = out[view, r]
        weights = factors[view]
        weighed = factors.shape[1] > 0
        _continue_side(
            row[:before],
            (begin, before),
            lower[:before],
            upper[:before],
            part,
            flat[:before],
            high,
            low * cut[r],
            fade[:before],
            weights[:before],
            weighed,
        )
        inside = row[before:after]
        if weighed:
            _weigh_line(inside, line, flat[before:after], high, weights[before:after])
        else:
            for c in range(cols):
                inside[c] = line[c]
        _continue_side(
            row[after:wide],
            (np.int64(0), end - after),
            lower[after:],
            upper[after:],
            part,
            flat[after:],
            high,
            top * cut[r],
            fade[after:],
            weights[after:],
            weighed,
        )
        for c in range(wide, padded):
            row[c] = np.float32(0)


@parallel
def add_bands(lines, start, values, band, share):
    """Add to each row the values of its two bands, mixed.

    lines: float32 (n, rows, columns), changed in place.
    start: first column that is added to.
    values: float32 (n, bands, cols).
    band, share: (rows,) lower band of each row, and how much the next one counts.
    """
    n, rows, _ = lines.shape
    bands, cols = values.shape[1:]
    for job in prange(n * rows):
        view = job // rows
        r = job % rows
        lower = values[view, band[r]]
        upper = values[view, min(band[r] + 1, bands - 1)]
        part = np.float32(share[r])
        line = lines[view, r]
        for c in range(cols):
            line[start + c] += lower[c] + part * (upper[c] - lower[c])


@kernel
def _cost(x, source, rays, length, seen, scale):
    """Compute half the sum of Cauchy's losses log(1 + r^2) of a prism's deviations r, in
    units of the scale; rays that miss the prism have path 0.

    Args:
        x: (6,) of `Prism.of`.
        source: (n, 2) in the plane, over the radius of the field of view.
        rays: (n, k, 2) likewise.
        length: (n, k) of these rays [mm].
        seen: (n, k) line integrals in the plane.
        scale: deviation from which on rays count less.
    """
    # Both axes and the attenuation are fitted as logarithms, so that every step leaves them
    # above 0.
    e = math.exp(x[2])
    f = math.exp(x[3])
    attenuation = math.exp(x[5])
    total = 0.0
    for i in range(len(seen)):
        px = source[i, 0] - x[0]
        py = source[i, 1] - x[1]
        for j in range(seen.shape[1]):
            dx = rays[i, j, 0]
            dy = rays[i, j, 1]
            along = x[4] * dx + f * dy
            squared = e * dx * e * dx + along * along
            apart = e * f * (px * dy - py * dx)
            inside = max(squared - apart * apart, 0.0)
            value = 2.0 * attenuation * length[i, j] * math.sqrt(inside) / squared
            rest = (value - seen[i, j]) / scale
            # Cauchy's: rays that see more than a prism must not pull without end.
            total += math.log1p(rest * rest)
    return 0.5 * total


@kernel
def _normal_equations(x, source, rays, length, seen, scale, slope, matrix, gradient):
    """Compute curvature (Gauss-Newton) and gradient of `_cost`.

    Rays that miss the prism add nothing; large residuals count less, and slopes near the
    rim are limited (`MIN_CHORD_SHARE`).

    Args:
        x: (6,) of `Prism.of`.
        source: see `_cost`.
        rays: see `_cost`.
        length: see `_cost`.
        seen: see `_cost`.
        scale: see `_cost`.
        slope: room for six numbers.
        matrix: (6, 6) lower triangle filled, the rest 0.
        gradient: (6,) filled.
    """
    e = math.exp(x[2])
    f = math.exp(x[3])
    attenuation = math.exp(x[5])
    matrix[:] = 0.0
    gradient[:] = 0.0
    for i in range(len(seen)):
        px = source[i, 0] - x[0]
        py = source[i, 1] - x[1]
        for j in range(seen.shape[1]):
            dx = rays[i, j, 0]
            dy = rays[i, j, 1]
            across = e * dx
            along = x[4] * dx + f * dy
            squared = across * across + along * along
            apart = e * f * (px * dy - py * dx)
            inside = squared - apart * apart
            if inside <= 0.0:
                continue
            root = math.sqrt(inside)
            unit = 2.0 * attenuation * length[i, j] / scale
            value = unit * root / squared
            rest = value - seen[i, j] / scale
            # Cauchy's loss as a weighted square: its slope over that of the square.
            pull = 1.0 / (1.0 + rest * rest)
            # value = unit sqrt(inside) / squared, inside = squared - apart^2. Of its slopes,
            # `steep` goes with half the change of `inside`, `flat` with that of `squared`.
            steep = unit / (squared * math.sqrt(max(inside, MIN_CHORD_SHARE * squared)))
            flat = value / squared
            slope[0] = steep * apart * e * f * dy
            slope[1] = -steep * apart * e * f * dx
            change = 2.0 * across * across
            slope[2] = steep * (0.5 * change - apart * apart) - flat * change
            change = 2.0 * along * f * dy
            slope[3] = steep * (0.5 * change - apart * apart) - flat * change
            change = 2.0 * along * dx
            slope[4] = steep * 0.5 * change - flat * change
            slope[5] = value
            for a in range(PARAMETERS):
                gradient[a] += pull * rest * slope[a]
                for b in range(a + 1):
                    matrix[a, b] += pull * slope[a] * slope[b]


@kernel
def _solved(matrix, gradient, free, damping, factor, step):
    """Compute the damped step of the free parameters by Cholesky.

    Args:
        matrix: (6, 6) curvature, lower triangle; unchanged.
        gradient: (6,).
        free: (6,) bool.
        damping: share of the diagonal that is added to it.
        factor: (6, 6) room.
        step: (6,) filled; 0 for parameters that are not free.

    Returns:
        True if there is a step; False if the matrix is not positive definite, then `step`
        is meaningless.
    """
    for a in range(PARAMETERS):
        step[a] = -gradient[a] if free[a] else 0.0
        for b in range(a + 1):
            # A parameter that is held has a row of the unit matrix: its step is 0, and the
            # others' are as if it were not there.
            value = matrix[a, b] if free[a] and free[b] else 0.0
            if a == b:
                # Marquardt's damping, relative to each curvature, serves parameters of all
                # units.
                value = value * (1.0 + damping) + 1e-12 if free[a] else 1.0
            for k in range(b):
                value -= factor[a, k] * factor[b, k]
            if a > b:
                factor[a, b] = value / factor[b, b]
            elif value > 0.0:
                factor[a, a] = math.sqrt(value)
            else:
                return False
    for a in range(PARAMETERS):
        for k in range(a):
            step[a] -= factor[a, k] * step[k]
        step[a] /= factor[a, a]
    for a in range(PARAMETERS - 1, -1, -1):
        for k in range(a + 1, PARAMETERS):
            step[a] -= factor[k, a] * step[k]
        step[a] /= factor[a, a]
    return True


@serial
def fit_prism(source, rays, length, seen, least, most, scale, x):
    """Fit a prism within bounds, in place, by damped Gauss-Newton steps
    (Levenberg-Marquardt).

    Parameters at a bound that the gradient pushes outwards are fixed for a step. Ends
    when the relative fall of the cost is at most `MIN_GAIN`, after MAX_STEPS, or if the
    damping exceeds `MOST_DAMPING`.

    Args:
        source: (n, 2) in the plane, over the radius of the field of view.
        rays: (n, k, 2) likewise.
        length: (n, k) of these rays [mm].
        seen: (n, k) line integrals in the plane.
        least, most: (6,) bounds.
        scale: deviation from which on rays count less.
        x: (6,) of `Prism.of`; the first guess, clipped to the bounds, then the result.

    Returns:
        The cost (`_cost` times scale^2).
    """
    slope = np.empty(PARAMETERS)
    gradient = np.empty(PARAMETERS)
    step = np.empty(PARAMETERS)
    matrix = np.empty((PARAMETERS, PARAMETERS))
    factor = np.empty((PARAMETERS, PARAMETERS))
    free = np.empty(PARAMETERS, np.bool_)
    trial = np.empty(PARAMETERS)
    for a in range(PARAMETERS):
        x[a] = min(max(x[a], least[a]), most[a])
    cost = _cost(x, source, rays, length, seen, scale)
    damping = FIRST_DAMPING
    fresh = False
    for _ in range(MAX_STEPS):
        if not fresh:
            _normal_equations(
                x, source, rays, length, seen, scale, slope, matrix, gradient
            )
            fresh = True
        for a in range(PARAMETERS):
            # Held for this step alone: else it would be solved for a way that it cannot go,
            # and the others would follow.
            outward = (x[a] <= least[a] and gradient[a] > 0.0) or (
                x[a] >= most[a] and gradient[a] < 0.0
            )
            free[a] = not outward
        other = math.inf
        if _solved(matrix, gradient, free, damping, factor, step):
            for a in range(PARAMETERS):
                trial[a] = min(max(x[a] + step[a], least[a]), most[a])
            other = _cost(trial, source, rays, length, seen, scale)
        if other < cost:
            gain = cost - other
            for a in range(PARAMETERS):
                x[a] = trial[a]
            cost = other
            fresh = False
            # Towards Gauss and Newton's step after a fall, towards a short one down the slope
            # after a rise; there the equations are still those of x.
            damping = max(0.2 * damping, LEAST_DAMPING)
            if gain <= MIN_GAIN * cost:
                break
        else:
            damping *= 5.0
            if damping > MOST_DAMPING:
                break
    return cost * scale * scale
