"""Compiled measurement of one bead's spot in a window of a line-integral image.

`measure` takes the centroid of a complete spot. `fit_ball` fits the profile of a ball to
the usable part of a spot, and to spots in noisy images.
"""

from __future__ import annotations

import math

import numpy as np

from flexdt.twin.projection.kernels.compiling import linked, serial

X, Y, RADIUS, PEAK, NOISE, SCORE, BIAS, VAR_X, COV_XY, VAR_Y, OK, MISFIT = range(12)
"""Places in the result of `measure` and `fit_ball`."""
RESULTS = 12

PARTIAL_ERROR = 0.004
"""Error of a partial spot's place per radius and missing share (measured: 0.007 px where a
tenth is missing)."""
FLOOR_PX = 0.0015
"""Error a centroid keeps even without noise: sampling on pixels (measured on clean images)."""
FIT_FLOOR_PX = 0.0025
"""The same for a fitted ball, whose assumed profile is never quite the pixels'."""


@linked
def bias_factor(ratio, power):  # type: ignore[no-untyped-def]
    """Compute the sphere-centre bias of a centroid weighted by chord^power, chords capped
    at `ratio`.

    0.8 for full chords (power 1), 2/3 for their squares, 1 for the outline: each level
    set of chords is the outline of a smaller concentric ball, displaced in proportion to
    its radius squared.

    Args:
        ratio: the cap as a share of the largest chord; limited to 0.001 to 1.
        power: of the weight.
    """
    c = min(max(ratio, 1e-3), 1.0)
    c2 = c * c
    p = power
    # chord^p up to the cap is a sum over levels t <= c with the weight p t^(p-1). Where a
    # ball's chord exceeds t, its outline's area and displacement both go with 1 - t^2: the
    # mean displacement is the integral of (1 - t^2)^2 over that of 1 - t^2, each over p c^p.
    above = 1.0 / p - 2.0 * c2 / (p + 2.0) + c2 * c2 / (p + 4.0)
    return above / (1.0 / p - c2 / (p + 2.0))


@linked
def weight_power(noise):  # type: ignore[no-untyped-def]
    """Return the power of the line integral that weights the centroid, for a noise.

    Pixels sample a ball's rim badly: the chord's power 1 errs by 0.007 px without noise,
    4 by 0.0001.
    """
    # Noise speaks for lower powers: best of a scan over powers and caps. Without noise a
    # power of 2 errs by 0.0015 px, of 3 by 0.0005.
    if noise < 0.002:
        return 4.0
    if noise < 0.006:
        return 3.0
    if noise < 0.02:
        return 2.5
    return 2.0


@linked
def weight_cap(noise, peak, cap):  # type: ignore[no-untyped-def]
    """Return the line integral above which the weight is constant, `cap` at most.

    A bead's middle is noisiest: the noise of a logarithm grows as exp(L / 2), and above
    0.3 is of no use.
    """
    limit = min(cap, max(1.5, 2.0 * math.log(0.3 / max(noise, 1e-6))))
    if noise < 0.002:
        return min(limit, 2.0 * peak)
    share = 0.8 if noise < 0.006 else 0.55
    return min(limit, max(2.0, share * peak))


@linked
def raised(value, power):  # type: ignore[no-untyped-def]
    """Return |value|^power with the value's sign, for power 2, 3 and 4; any other is
    taken as 2.5, as in `weight_power`.
    """
    size = abs(value)
    if power == 2.0:
        return value * size
    if power == 3.0:
        return value * size * size
    if power == 4.0:
        return value * size * size * size
    return value * size * math.sqrt(size)


@linked
def median(values, n):  # type: ignore[no-untyped-def]
    """Compute the median of `values[:n]`, reordering `values` in place (Hoare's
    quickselect).

    For an even n the mean of the two in the middle. numba's own takes three times as long
    to compile.

    Args:
        values: (n or more,), without NaN.
        n: above 0.
    """
    middle, low, high = n // 2, 0, n - 1
    while low < high:
        pivot = values[(low + high) // 2]
        i, j = low, high
        while i <= j:
            while values[i] < pivot:
                i += 1
            while values[j] > pivot:
                j -= 1
            if i <= j:
                values[i], values[j] = values[j], values[i]
                i += 1
                j -= 1
        if middle <= j:
            high = j
        elif middle >= i:
            low = i
        else:
            break
    if n % 2 == 1:
        return values[middle]
    # The selection has left the lower half, whose largest is the other one in the middle,
    # before it.
    below = values[0]
    for i in range(1, middle):
        below = max(below, values[i])
    return (below + values[middle]) / 2


@linked
def solve(matrix, right, out):  # type: ignore[no-untyped-def]
    """Solve matrix @ out = right for a few unknowns into `out`: elimination with partial
    pivoting.

    `matrix` and `right` are kept. There is no check for a singular matrix.

    LAPACK's solver, and the checks that numba adds to it, take seconds to compile.

    Args:
        matrix: (p, p).
        right: (p,).
        out: (p,), written.
    """
    n = out.size
    a = matrix.copy()
    for i in range(n):
        out[i] = right[i]
    for k in range(n):
        best = k
        for i in range(k + 1, n):
            if abs(a[i, k]) > abs(a[best, k]):
                best = i
        for c in range(n):
            a[k, c], a[best, c] = a[best, c], a[k, c]
        out[k], out[best] = out[best], out[k]
        for i in range(k + 1, n):
            share = a[i, k] / a[k, k]
            for c in range(k, n):
                a[i, c] -= share * a[k, c]
            out[i] -= share * out[k]
    for k in range(n - 1, -1, -1):
        for c in range(k + 1, n):
            out[k] -= a[k, c] * out[c]
        out[k] /= a[k, k]


@linked
def background(image, x0, y0, inner, outer, plane):  # type: ignore[no-untyped-def]
    """Fit a robust plane through the ring around (x0, y0), and return its noise.

    The ring's median and spread come first, so that a neighbor or an edge in the ring
    does not pull the plane; then two fits without pixels beyond 3 and 2.5 spreads. NaN
    pixels are left out.

    Args:
        image: (rows, cols) line integrals.
        x0, y0: center [px].
        inner, outer: radii of the ring [px].
        plane: (3,) value at the center, d/dx and d/dy, written; the median without slope
            if a fit fails.

    Returns:
        Standard deviation; -1 if fewer than 12 pixels of the ring are in the image.
    """
    rows, cols = image.shape
    left, right = max(0, math.floor(x0 - outer)), min(cols - 1, math.ceil(x0 + outer))
    top, bottom = max(0, math.floor(y0 - outer)), min(rows - 1, math.ceil(y0 + outer))
    if right < left or bottom < top:
        return -1.0
    values = np.empty((right - left + 1) * (bottom - top + 1))
    dx = np.empty_like(values)
    dy = np.empty_like(values)
    n = 0
    for i in range(top, bottom + 1):
        for j in range(left, right + 1):
            d2 = (j - x0) ** 2 + (i - y0) ** 2
            if inner * inner <= d2 <= outer * outer and not math.isnan(image[i, j]):
                values[n] = image[i, j]
                dx[n] = j - x0
                dy[n] = i - y0
                n += 1
    if n < 12:
        return -1.0
    # A third of the pixels tells well enough which of them to use.
    every = 3 if n > 300 else 1
    few = (n + every - 1) // every
    some = np.empty(few)
    for i in range(few):
        some[i] = values[i * every]
    middle = median(some, few)
    for i in range(few):
        some[i] = abs(some[i] - middle)
    spread = 1.4826 * median(some, few) + 1e-9
    plane[0], plane[1], plane[2] = middle, 0.0, 0.0
    a = np.zeros((3, 3))
    b = np.zeros(3)
    for turn in range(2):
        a[:] = 0.0
        b[:] = 0.0
        limit = (3.0 if turn == 0 else 2.5) * spread
        total = 0.0
        count = 0
        for i in range(n):
            r = values[i] - plane[0] - plane[1] * dx[i] - plane[2] * dy[i]
            if abs(r) > limit:
                continue
            total += r * r
            count += 1
            a[0, 0] += 1.0
            a[0, 1] += dx[i]
            a[0, 2] += dy[i]
            a[1, 1] += dx[i] * dx[i]
            a[1, 2] += dx[i] * dy[i]
            a[2, 2] += dy[i] * dy[i]
            b[0] += values[i]
            b[1] += values[i] * dx[i]
            b[2] += values[i] * dy[i]
        if count < 12:
            return spread
        a[1, 0], a[2, 0], a[2, 1] = a[0, 1], a[0, 2], a[1, 2]
        det = (
            a[0, 0] * (a[1, 1] * a[2, 2] - a[1, 2] * a[2, 1])
            - a[0, 1] * (a[1, 0] * a[2, 2] - a[1, 2] * a[2, 0])
            + a[0, 2] * (a[1, 0] * a[2, 1] - a[1, 1] * a[2, 0])
        )
        if abs(det) < 1e-9 * a[0, 0] * (a[1, 1] + 1e-12) * (a[2, 2] + 1e-12):
            return spread
        solve(a, b, plane)
        total = 0.0
        count = 0
        for i in range(n):
            r = values[i] - plane[0] - plane[1] * dx[i] - plane[2] * dy[i]
            if abs(r) <= limit:
                total += r * r
                count += 1
        spread = math.sqrt(total / max(count - 3, 1)) + 1e-9
    return spread


@serial
def measure(image, x0, y0, radius0, cap, least, result):  # type: ignore[no-untyped-def]
    """Measure the centroid of a complete spot near (x0, y0), in up to 7 rounds about the
    last place.

    Fails, which leaves OK 0, if the spot is cut by the image's edge, not brighter than
    its background, or moves by 1.5 expected radii.

    Args:
        image: (rows, cols) line integrals.
        x0, y0: start [px].
        radius0: expected radius of the spot [px]; the measured one is limited to 0.6 to
            1.6 times it.
        cap: largest line integral above background; larger ones are cut, lower where they
            are noisier.
        least: least noise, which decides on the weight of pixels.
        result: (RESULTS,), written; see the names of its places. SCORE is the likeness to
            a ball, NOISE the background's.
    """
    rows, cols = image.shape
    plane = np.zeros(3)
    x, y, radius = x0, y0, radius0
    result[:] = 0.0
    peak, factor, noise, limit, s, power = 0.0, 0.8, 0.0, 0.0, 0.0, 2.0
    centre_x, centre_y = x, y
    for turn in range(7):
        reach = 1.12 * radius + 1.5
        if x - reach < 0 or y - reach < 0 or x + reach > cols - 1 or y + reach > rows - 1:
            return
        # The ring is the dearest part: it is taken anew only where the spot has moved by a
        # third of a pixel, and late rounds keep it, so that they settle.
        moved = (x - centre_x) ** 2 + (y - centre_y) ** 2 > 0.1
        if turn == 0 or (turn < 4 and moved):
            noise = background(image, x, y, reach + 1.0, 1.55 * radius + 4.0, plane)
            if noise < 0:
                return
            noise = max(noise, least)
            centre_x, centre_y = x, y
        core = np.empty(int((0.7 * radius + 2) ** 2) + 4)
        n = 0
        for i in range(int(y - 0.3 * radius), int(y + 0.3 * radius) + 2):
            for j in range(int(x - 0.3 * radius), int(x + 0.3 * radius) + 2):
                part = 1.0 - ((j - x) ** 2 + (i - y) ** 2) / (radius * radius)
                if n < core.shape[0] and part > 0.3:
                    value = (
                        plane[0] + plane[1] * (j - centre_x) + plane[2] * (i - centre_y)
                    )
                    # Each pixel near the middle tells the peak: its own chord is known from
                    # its place.
                    core[n] = (image[i, j] - value) / math.sqrt(part)
                    n += 1
        if n == 0:
            return
        peak = median(core, n)
        if peak <= 0:
            return
        limit = weight_cap(noise, peak, cap)
        power = weight_power(noise)
        s, sx, sy, sxx, sxy, syy = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
        for i in range(math.ceil(y - reach), math.floor(y + reach) + 1):
            for j in range(math.ceil(x - reach), math.floor(x + reach) + 1):
                dx, dy = j - x, i - y
                d2 = dx * dx + dy * dy
                if d2 > reach * reach:
                    continue
                value = (
                    image[i, j]
                    - plane[0]
                    - plane[1] * (j - centre_x)
                    - plane[2] * (i - centre_y)
                )
                w = raised(min(value, limit), power)
                s += w
                sx += w * dx
                sy += w * dy
                sxx += w * dx * dx
                sxy += w * dx * dy
                syy += w * dy * dy
        if s <= 0:
            return
        mx, my = sx / s, sy / s
        factor = bias_factor(limit / peak if peak > limit else 1.0, power)
        # A disc of radius r has the mean square distance r^2 / 2. Averaged over the outlines
        # of the weight's levels, r^2 / R^2 is the bias factor: spread = factor R^2 / 2.
        spread = (sxx + syy) / s - mx * mx - my * my
        x += mx
        y += my
        if turn == 2:
            if spread <= 0:
                return
            radius = min(
                max(math.sqrt(2.0 * spread / factor), 0.6 * radius0), 1.6 * radius0
            )
        if not (abs(x - x0) < 1.5 * radius0 and abs(y - y0) < 1.5 * radius0):
            return
        if turn >= 3 and mx * mx + my * my < 1e-7:
            break
    _variance(
        image,
        x,
        y,
        1.12 * radius + 1.5,
        limit,
        noise,
        power,
        plane,
        centre_x,
        centre_y,
        s,
        result,
    )
    result[SCORE] = _likeness(
        image, x, y, radius, peak, limit, noise, plane, centre_x, centre_y
    )
    result[X], result[Y], result[RADIUS] = x, y, radius
    result[PEAK], result[NOISE], result[BIAS] = peak, noise, factor
    result[OK] = 1.0


@linked
def _variance(image, x, y, reach, limit, noise, power, plane, cx, cy, mass, result):  # type: ignore[no-untyped-def]
    """Write the covariance of a capped centroid: photon noise of a logarithm grows as exp(L /
    2).

    Pixels at or above the limit add nothing; variances get `FLOOR_PX` squared in addition.

    `image`: (rows, cols) line integrals; `x` and `y`: centroid [px]; `reach`: radius of the used
    pixels [px]; `limit`: line integral at which values are cut; `noise`: of the background;
    `power`: of the weight; `plane`: background about (cx, cy); `cx` and `cy`: its origin [px];
    `mass`: sum of the weights; `result`: VAR_X, COV_XY and VAR_Y are written [px^2].
    """
    vx, vxy, vy = 0.0, 0.0, 0.0
    for i in range(math.ceil(y - reach), math.floor(y + reach) + 1):
        for j in range(math.ceil(x - reach), math.floor(x + reach) + 1):
            dx, dy = j - x, i - y
            value = image[i, j] - plane[0] - plane[1] * (j - cx) - plane[2] * (i - cy)
            if dx * dx + dy * dy <= reach * reach and value < limit:
                # Slope of the weight, p value^(p-1), times the noise; squared, that grows as
                # exp(value).
                v = noise * power * abs(raised(value, power) / max(abs(value), 1e-9))
                v = v * v * math.exp(max(value, 0.0))
                vx += v * dx * dx
                vxy += v * dx * dy
                vy += v * dy * dy
    result[VAR_X] = vx / (mass * mass) + FLOOR_PX * FLOOR_PX
    result[COV_XY] = vxy / (mass * mass)
    result[VAR_Y] = vy / (mass * mass) + FLOOR_PX * FLOOR_PX


@linked
def _likeness(image, x, y, radius, peak, cap, noise, plane, cx, cy):  # type: ignore[no-untyped-def]
    """Compute the correlation of the spot with a ball's profile within 1.3 radii and 1
    px, corrected for noise: a faint ball is no less like one.

    At most three quarters of the variance are taken for noise; the result may exceed 1.

    Args:
        image: (rows, cols) line integrals.
        x, y, radius: of the spot [px].
        peak: its contrast.
        cap: line integral at which values are cut.
        noise: of the background.
        plane: background about (cx, cy).
        cx, cy: its origin [px].

    Returns:
        0 if image or profile has no variance.
    """
    limit = min(cap, peak)
    reach = 1.3 * radius + 1.0
    n, sa, sb, saa, sab, sbb = 0, 0.0, 0.0, 0.0, 0.0, 0.0
    rows, cols = image.shape
    for i in range(max(0, int(y - reach)), min(rows, int(y + reach) + 2)):
        for j in range(max(0, int(x - reach)), min(cols, int(x + reach) + 2)):
            d2 = ((j - x) ** 2 + (i - y) ** 2) / (radius * radius)
            a = min(
                image[i, j] - plane[0] - plane[1] * (j - cx) - plane[2] * (i - cy), limit
            )
            b = min(peak * math.sqrt(max(0.0, 1.0 - d2)), limit)
            n += 1
            sa += a
            sb += b
            saa += a * a
            sab += a * b
            sbb += b * b
    va, vb = saa - sa * sa / n, sbb - sb * sb / n
    if va <= 0 or vb <= 0:
        return 0.0
    va = max(va - n * noise * noise, 0.25 * va)
    return (sab - sa * sb / n) / math.sqrt(va * vb)


@linked
def ball_table(radius, peak, blur, veil, table, slope):  # type: ignore[no-untyped-def]
    """Tabulate line integrals of a blurred ball along its radius in steps of 1/8 px, and
    their slope.

    The blur acts on intensities, before the logarithm, so a strong bead's spot looks
    smaller. Approximate: a blur along the radius, corrected by the Laplacian.

    Args:
        radius: of the ball [px].
        peak: line integral through its middle.
        blur: standard deviation [px], above 0.
        veil: part of the light about the ball that no ball takes away.
        table, slope: (n,), written; the slope is a pixel's.
    """
    n = table.shape[0]
    half = math.ceil(3.0 * blur * 8.0)
    kernel = np.empty(2 * half + 1)
    total = 0.0
    for i in range(-half, half + 1):
        kernel[i + half] = math.exp(-0.5 * (i / (8.0 * blur)) ** 2)
        total += kernel[i + half]
    through = np.empty(n + half)
    for k in range(n + half):
        d = k / (8.0 * radius)
        through[k] = math.exp(-peak * math.sqrt(1.0 - d * d)) if d < 1.0 else 1.0
        through[k] = veil + (1.0 - veil) * through[k]
    for k in range(n):
        value = 0.0
        for i in range(-half, half + 1):
            # The profile is even: before the middle it is what it is behind it.
            value += kernel[i + half] * through[abs(k + i)]
        slope[k] = value / total
    for k in range(n):
        # Blurring along the radius alone misses the rim's curvature: the Laplacian of a radial
        # function is f'' + f' / d.
        below, above = slope[max(k - 1, 0)], slope[min(k + 1, n - 1)]
        bend = 4.0 * (above - below) / max(k / 8.0, 1.0)
        table[k] = -math.log(max(slope[k] + 0.5 * blur * blur * bend, 1e-9))
    for k in range(n):
        below, above = table[max(k - 1, 0)], table[min(k + 1, n - 1)]
        slope[k] = (above - below) * (4.0 if 0 < k < n - 1 else 8.0)


@linked
def _level(image, mask, masked, x, y, inner, outer):  # type: ignore[no-untyped-def]
    """Return the median of the usable pixels in a ring, 0 without any.

    Args:
        image: (rows, cols).
        mask: (rows, cols), 0 where a pixel must not be used.
        masked: whether the mask counts.
        x, y: center [px].
        inner, outer: radii of the ring [px].
    """
    rows, cols = image.shape
    side = int(2 * outer + 3)
    values = np.empty(side * side)
    n = 0
    for i in range(
        max(0, math.ceil(y - outer)), min(rows - 1, math.floor(y + outer)) + 1
    ):
        for j in range(
            max(0, math.ceil(x - outer)), min(cols - 1, math.floor(x + outer)) + 1
        ):
            if masked and mask[i, j] == 0:
                continue
            d2 = (j - x) ** 2 + (i - y) ** 2
            if inner * inner <= d2 <= outer * outer and n < values.shape[0]:
                values[n] = image[i, j]
                n += 1
    return median(values, n) if n > 0 else 0.0


@serial
def fit_ball(  # type: ignore[no-untyped-def]
    image, mask, x0, y0, radius, stretch, peak, blur, veil, sloped, free_radius, result
):
    """Fit a blurred ball to the usable part of a spot, weighted by photon counts: place
    and background's level, in up to 25 damped steps.

    Residuals are those of the intensity divided by its square root, which is what a
    Poisson likelihood weighs; most information about the place comes from the rim. Fails,
    which leaves `result` 0, with fewer than 20 usable pixels, less than 0.15 of the spot,
    a singular matrix, or a step of 1.2 radii from the start.

    Args:
        image: (rows, cols) line integrals.
        mask: (rows, cols) uint8, 0 where a pixel must not be used; or (0, 0): all may.
        x0, y0: start [px]; the center may be outside the image.
        radius: minor semi-axis of the spot [px]; peak: line integral that is seen in its
            middle.
        stretch: (3,) direction of the major semi-axis (unit, column and row) and its
            ratio to the minor one.
        blur: standard deviation of the image's blur [px].
        veil: part of the light about the spot that the ball does not take away however
            thick it is: scattered light, or high energies.
        sloped: take the background's slope from the ring round the spot; else it is
            level.
        free_radius: estimate the radius too, 0.8 to 1.25 times the given one.
        result: filled as by `measure`; SCORE is the share of the spot used, NOISE what is left
            as a share of the spot's contrast, and MISFIT the same beyond photons' noise, as the
            ring round the spot shows it.
    """
    rows, cols = image.shape
    result[:] = 0.0
    reach = 1.35 * radius * stretch[2] + 3.0
    flatten = 1.0 - 1.0 / (stretch[2] * stretch[2])
    size = int(8.0 * (reach + 4.0)) + 8
    table = np.empty(size)
    slope = np.empty(size)
    # Blur takes from the middle of a small ball, too: what is seen there is what it leaves.
    middle, through = int(1.6 * radius), peak
    for _ in range(6):
        ball_table(radius, through, blur, veil, table, slope)
        seen = table[middle] / math.sqrt(1.0 - (middle / (8.0 * radius)) ** 2)
        through = min(through * peak / max(seen, 1e-9), 3.0 * peak / (1.0 - veil))
    masked = mask.shape[0] > 0
    base = _level(image, mask, masked, x0, y0, 1.12 * radius + 1.0, reach)
    plane = np.zeros(3)
    if sloped:
        inner, outer = 1.12 * radius + 2.5, 1.55 * radius + 4.0
        if background(image, x0, y0, inner, outer, plane) < 0:
            plane[:] = 0.0
    x, y, scale = x0, y0, 1.0
    used, count, clear = 0, 0, 1.0
    total, misfit, power, passed = 0.0, 0.0, 1.0, 0.0
    before = 1e300
    h = np.zeros((4, 4))
    g = np.zeros(4)
    j = np.zeros(4)
    step = np.zeros(4)
    for _ in range(25):
        left, right = max(0, math.ceil(x - reach)), min(cols - 1, math.floor(x + reach))
        top, bottom = max(0, math.ceil(y - reach)), min(rows - 1, math.floor(y + reach))
        h[:] = 0.0
        g[:] = 0.0
        total, misfit, power, passed = 0.0, 0.0, 1e-12, 0.0
        count, used = 0, 0
        clear = math.exp(-base)
        for row in range(top, bottom + 1):
            for col in range(left, right + 1):
                if masked and mask[row, col] == 0:
                    continue
                dx, dy = col - x, row - y
                along = dx * stretch[0] + dy * stretch[1]
                # Distance in the ellipse's own measure, and minus its gradient.
                d = (
                    math.sqrt(max(dx * dx + dy * dy - flatten * along * along, 0.0))
                    / scale
                )
                if d > reach - 1.0:
                    continue
                dx = (dx - flatten * along * stretch[0]) / (scale * scale)
                dy = (dy - flatten * along * stretch[1]) / (scale * scale)
                cell = int(d * 8.0)
                part = d * 8.0 - cell
                value = table[cell] * (1 - part) + table[cell + 1] * part
                rise = slope[cell] * (1 - part) + slope[cell + 1] * part
                expected = math.exp(-value - base)
                seen = image[row, col] - plane[1] * (col - x0) - plane[2] * (row - y0)
                seen = math.exp(-min(max(seen, -1.0), 20.0))
                # A count's variance is its mean: over the root, all pixels have the same
                # noise.
                root = math.sqrt(expected + 1e-6)
                r = (seen - expected) / root
                count += 1
                total += r * r
                misfit += (seen - expected) ** 2
                passed += expected
                power += (seen - clear) ** 2
                if d < radius:
                    used += 1
                # In the very middle the gradient has no direction.
                if d < 1e-6:
                    continue
                # d(expected)/dp = -expected dL/dp; dL/dx = -rise dx/d; the residual is seen
                # less expected, so its derivative has the other sign.
                pull = expected / root
                j[0], j[1] = -pull * rise * dx / d, -pull * rise * dy / d
                j[2] = pull
                j[3] = -pull * rise * d / scale if free_radius else 0.0
                for a in range(4):
                    g[a] -= j[a] * r
                    for b in range(4):
                        h[a, b] += j[a] * j[b]
        if count < 20 or used < 0.15 * math.pi * radius * radius:
            return
        if not free_radius:
            # A radius that is held has a row of the unit matrix, and its step is 0.
            h[3, 3] = 1.0
        # Where all of the rim that is seen points one way, the place across it is open: the
        # determinant of both coordinates is then small against its diagonal's.
        minor = h[0, 0] * h[1, 1] - h[0, 1] ** 2
        if h[2, 2] <= 0 or h[3, 3] <= 0 or minor < 1e-6 * h[0, 0] * h[1, 1] or minor <= 0:
            return
        solve(h, g, step)
        length = math.sqrt(step[0] ** 2 + step[1] ** 2)
        # Slopes are those of the rim: a step of more than a third of the radius leaves where
        # they hold. A rise of the misfit cannot be taken back, but shortens what follows.
        damp = min(1.0, 0.35 * radius / (length + 1e-12))
        if total > before * 1.2:
            damp *= 0.3
        before = total
        x += damp * step[0]
        y += damp * step[1]
        base += min(max(damp * step[2], -0.5), 0.5)
        scale = min(max(scale + damp * step[3], 0.8), 1.25)
        if not (abs(x - x0) < 1.2 * radius and abs(y - y0) < 1.2 * radius):
            return
        if length < 1e-4:
            break
    # Covariance of the place alone: level and radius are estimated too, so the whole matrix
    # is inverted, of which two rows are needed.
    inverse, unit = (
        np.zeros((2, 4)),
        np.zeros((2, 4)),
    )  # its first two rows are all that is used
    for a in range(2):
        unit[a, a] = 1.0
        solve(h, unit[a], inverse[a])
    variance = total / max(count - 4, 1)
    share = used / (math.pi * radius * radius)
    # What is missing of a spot makes its centre depend on its radius and blur.
    slack = PARTIAL_ERROR * radius * max(1.0 - share, 0.0)
    floor = FIT_FLOOR_PX * FIT_FLOOR_PX + slack * slack
    result[VAR_X] = inverse[0, 0] * variance + floor
    result[COV_XY] = inverse[0, 1] * variance
    result[VAR_Y] = inverse[1, 1] * variance + floor
    result[X], result[Y], result[RADIUS] = x, y, radius * scale
    result[PEAK], result[NOISE] = peak, math.sqrt(misfit / power)
    # A count's variance is its mean, and in the ring the square of the logarithm's noise is that
    # of a count of the light there.
    noise = background(image, x, y, 1.12 * radius + 2.5, 1.55 * radius + 4.0, plane)
    by_noise = max(noise, 0.0) ** 2 * clear * passed
    result[MISFIT] = math.sqrt(max(misfit - by_noise, 0.0) / power)
    result[BIAS] = 0.93  # the rim decides: between full chords (0.8) and the outline (1)
    result[SCORE] = share
    result[OK] = 1.0
