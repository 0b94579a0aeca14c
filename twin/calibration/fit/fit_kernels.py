"""Compiled kernels of the fit: residuals, exact derivatives, normal equations.

For any subset of the seventeen offsets, of the told lengths (`geometry.told_lengths`), and for the
beads themselves, they compute the same as
`Poses.cone_vec(parameters).project_points(beads)`. That makes this
the second place where offsets meet geometry: tests/twin/calibration/test_kernel_binding.py
compares values and derivatives of all with `Poses.cone_vec`, and fails if any one sign
here is flipped. `fit.problem` builds and checks the arguments.

Forward model of frame n and bead b, in the world frame: q = c + T R (b + m - tau), c = O
+ dO + pivot * tau (pivot 1: eq. 5.4 as printed; 0: R(b - tau) + O), R clockwise from
above by alpha + angle_scale * phi, T the axis tilt, m the place of a stage on the
turntable. With w = q - S, g = D - S and the pixel steps u, v the bead's center is
projected to column w.P / w.n and row w.Q / w.n from the detector's center, P = v x g, Q =
g x u, n = u x v: Cramer's rule, valid for any u, v. The spot of a ball is displaced from
the projection of its center: spot = a + bias * (r / depth)^2 (a - foot), bias 1 for the
outline's center, 0.8 for the chord-weighted centroid, 0 for points (calibration.md,
"Images").

All of a frame is in a matrix from beads to columns, rows and depths: the product of three
rows, which know the panel and the source, and four columns, which know the object. Derivatives
by turns of the detector are imaginary parts: where a parameter has the imaginary part h, a
smooth real function has h times its slope, exact to rounding (Squire and Trapp, SIAM Review 40
(1998) 110). All others are written out: they are a few products each.
"""

from __future__ import annotations

import cmath
import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from flexdt.twin.geometry.conventions import FloatArray
from flexdt.twin.projection.kernels.compiling import maker, serial

OFFSETS = 17
PARAMETERS = 28
# Places of the parameters in a row of `params`: the order of `offsets.NAMES`, then that of
# `geometry.told_lengths.TOLD`. Unity's axes are in the names: _x is the world's x, _y its z, _z
# its y.
# numba compiles globals in as constants.
DO_X, DO_Y, DO_Z, ALPHA, TAU_X, TAU_Z, DD_X, DD_Y, DD_Z, DS_X, DS_Y = range(11)
ROLL, PITCH, YAW, TILT_X, TILT_Z, ANGLE_SCALE = range(11, OFFSETS)
TRAVEL, PANEL_TRAVEL, PLACE, PIXEL, PHANTOM = (
    17,
    20,
    23,
    26,
    27,
)  # the first three: x, y, z
# First columns of a row of `geometry`.
SOURCE, AXIS, DETECTOR, U, V, ANGLE, MOUNT, WAY, PANEL_WAY = (
    0, 3, 6, 9, 12, 15, 16, 18, 21,
)  # fmt: skip
GEOMETRY = 24
"""Columns of `geometry`."""
UNITY = 0, 2, 1
"""Axis of the world of each of Unity's x, y, z, and the other way round."""
IMAGINARY_STEP = 1e-30
"""Imaginary part of a parameter for its derivative: its square is negligible."""


@maker(forceinline=True)
def _dot(a, b):  # type: ignore[no-untyped-def]
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@maker(forceinline=True)
def _cross(a, b):  # type: ignore[no-untyped-def]
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


@maker(forceinline=True)
def _wave(angle):  # type: ignore[no-untyped-def]
    """Return cosine and sine of an angle with a small imaginary part."""
    c, s = math.cos(angle.real), math.sin(angle.real)
    return complex(c, -s * angle.imag), complex(s, c * angle.imag)


@maker(forceinline=True)
def _unit(a):  # type: ignore[no-untyped-def]
    scale = 1.0 / cmath.sqrt(_dot(a, a))
    return a[0] * scale, a[1] * scale, a[2] * scale


@maker
def _turned(vector, axis, angle):  # type: ignore[no-untyped-def]
    """Turn `vector` (x, y, z) about the direction `axis`, of any length, by `angle`
    [rad], right-handed (Rodrigues); returns a tuple of three complex numbers.
    """
    c, s = _wave(angle)
    k = _unit(axis)
    t = (1.0 - c) * _dot(k, vector)
    x, y, z = _cross(k, vector)
    return (
        c * vector[0] + s * x + t * k[0],
        c * vector[1] + s * y + t * k[1],
        c * vector[2] + s * z + t * k[2],
    )


@maker
def _clear(table):  # type: ignore[no-untyped-def]
    """Set all elements of a table (m, n) to 0."""
    for r in range(table.shape[0]):
        for c in range(table.shape[1]):
            table[r, c] = 0.0


@maker
def panel_rows(p, geo, rows, steps):  # type: ignore[no-untyped-def]
    """Compute the rows of a frame, which take a place, from the source, to column, row and 1,
    times its depth [mm].

    Angles are [rad], lengths [mm]; complex numbers serve for derivatives.

    Args:
        p: (28,) complex parameters.
        geo: (24,) complex, see `Data`.
        rows: (3, 3) written; the last is the panel's unit normal.
        steps: (2, 3) the steps of a pixel to the right and down, over the pixel's area [1/mm];
            written.
    """
    g = (
        geo[DETECTOR] + p[DD_X] + p[PANEL_TRAVEL] * geo[PANEL_WAY]
        - geo[SOURCE] - p[DS_X],
        geo[DETECTOR + 1] + p[DD_Z] + p[PANEL_TRAVEL + 2] * geo[PANEL_WAY + 1]
        - geo[SOURCE + 1],
        geo[DETECTOR + 2] + p[DD_Y] + p[PANEL_TRAVEL + 1] * geo[PANEL_WAY + 2]
        - geo[SOURCE + 2] - p[DS_Y],
    )  # fmt: skip
    # As `conventions.turn_detector` has it.
    wide = 1.0 + p[PIXEL]
    v = wide * geo[V], wide * geo[V + 1], wide * geo[V + 2]
    u = wide * geo[U], wide * geo[U + 1], wide * geo[U + 2]
    # Complex numbers: an angle of 0 with a step for its derivative is not 0, and turns.
    if p[YAW] != 0.0 or p[PITCH] != 0.0 or p[ROLL] != 0.0:
        u = _turned(u, v, p[YAW])
        v = _turned(v, u, p[PITCH])
        n = _cross(u, v)
        u, v = _turned(u, n, p[ROLL]), _turned(v, n, p[ROLL])
    n = _cross(u, v)
    scale = 1.0 / cmath.sqrt(_dot(n, n))
    for r, row in enumerate((_cross(v, g), _cross(g, u), n)):
        for c in range(3):
            rows[r, c] = row[c] * scale
    for r, step in enumerate((u, v)):
        for c in range(3):
            steps[r, c] = step[c] * scale


@maker
def object_columns(p, geo, pivot, columns):  # type: ignore[no-untyped-def]
    """Compute the columns of a frame: a bead (x, y, z, 1) is at the sum of their products,
    from the source [mm].

    Args:
        p: (28,) parameters; a phantom that grows has the same columns, see `evaluate`.
        geo: (24,) see `Data`.
        pivot: 1.0 or 0.0, see the module.
        columns: (4, 3) written.
    """
    # T = Ry(axis_tilt_z) Rx(axis_tilt_x), and R clockwise from above: columns of T R.
    cx, sx = math.cos(p[TILT_X]), math.sin(p[TILT_X])
    cz, sz = math.cos(p[TILT_Z]), math.sin(p[TILT_Z])
    angle = p[ALPHA] + p[ANGLE_SCALE] * geo[ANGLE]
    ca, sa = math.cos(angle), math.sin(angle)
    x = ca * cz - sa * sz * sx, -sa * cx, -ca * sz - sa * cz * sx
    y = sa * cz + ca * sz * sx, ca * cx, -sa * sz + ca * cz * sx
    z = sz * cx, -sx, cz * cx
    bx, by = geo[MOUNT] - p[TAU_X], geo[MOUNT + 1] - p[TAU_Z]
    still = (
        x[0] * bx + y[0] * by + geo[AXIS] + p[DO_X] + pivot * p[TAU_X]
        + p[PLACE] + p[TRAVEL] * geo[WAY] - geo[SOURCE] - p[DS_X],
        x[1] * bx + y[1] * by + geo[AXIS + 1] + p[DO_Z] + pivot * p[TAU_Z]
        + p[PLACE + 2] + p[TRAVEL + 2] * geo[WAY + 1] - geo[SOURCE + 1],
        x[2] * bx + y[2] * by + geo[AXIS + 2] + p[DO_Y]
        + p[PLACE + 1] + p[TRAVEL + 1] * geo[WAY + 2] - geo[SOURCE + 2] - p[DS_Y],
    )  # fmt: skip
    for c, column in enumerate((x, y, z, still)):
        for a in range(3):
            columns[c, a] = column[a]


@maker
def object_slopes(i, p, geo, pivot, columns, slopes):  # type: ignore[no-untyped-def]
    """Compute the derivatives of a frame's columns by a parameter.

    Args:
        i: number of the parameter.
        p, geo, pivot: see `object_columns`.
        columns: (4, 3) of it.
        slopes: (4, 3) written.
    """
    _clear(slopes)
    x, y, z = columns[0], columns[1], columns[2]
    bx, by = geo[MOUNT] - p[TAU_X], geo[MOUNT + 1] - p[TAU_Z]
    if i == DO_X:
        slopes[3, 0] = 1.0
    elif i == DO_Z:
        slopes[3, 1] = 1.0
    elif i == DO_Y:
        slopes[3, 2] = 1.0
    elif i == DS_X:
        slopes[3, 0] = -1.0
    elif i == DS_Y:
        slopes[3, 2] = -1.0
    elif i == TAU_X:
        for a in range(3):
            slopes[3, a] = -x[a]
        slopes[3, 0] += pivot
    elif i == TAU_Z:
        for a in range(3):
            slopes[3, a] = -y[a]
        slopes[3, 1] += pivot
    elif i in (ALPHA, ANGLE_SCALE):
        amount = 1.0
        if i == ANGLE_SCALE:
            amount = geo[ANGLE]
        # R turns x towards -y: the slope of its column x is -y, that of y is x.
        for a in range(3):
            slopes[0, a] = -amount * y[a]
            slopes[1, a] = amount * x[a]
            slopes[3, a] = slopes[0, a] * bx + slopes[1, a] * by
    elif i == TILT_X:
        angle = p[ALPHA] + p[ANGLE_SCALE] * geo[ANGLE]
        ca, sa = math.cos(angle), math.sin(angle)
        for a in range(3):
            slopes[0, a] = -sa * z[a]
            slopes[1, a] = ca * z[a]
            slopes[2, a] = sa * x[a] - ca * y[a]
            slopes[3, a] = slopes[0, a] * bx + slopes[1, a] * by
    elif PLACE <= i < PLACE + 3:
        slopes[3, UNITY[i - PLACE]] = 1.0
    elif TRAVEL <= i < TRAVEL + 3:
        along = UNITY[i - TRAVEL]
        slopes[3, along] = geo[WAY + along]
    elif i == TILT_Z:
        for c in range(3):
            # The outermost turn, about the world's y: it turns all columns alike.
            slopes[c, 0] = columns[c, 2]
            slopes[c, 2] = -columns[c, 0]
        for a in range(3):
            slopes[3, a] = slopes[0, a] * bx + slopes[1, a] * by


@maker
def panel_slopes(i, p, geo, steps, rows, turned_steps, slopes):  # type: ignore[no-untyped-def]
    """Compute the derivatives of a frame's rows by a parameter.

    Args:
        i: number of the parameter.
        p, geo: as of `panel_rows`; p is the same again afterwards.
        steps: (2, 3) of it, real.
        rows: (3, 3) complex, for intermediate results.
        turned_steps: (2, 3) likewise.
        slopes: (3, 3) written.
    """
    _clear(slopes)
    away = 0.0, 0.0, 0.0  # how the panel's centre moves from the source
    if i == DD_X:
        away = 1.0, 0.0, 0.0
    elif i == DD_Z:
        away = 0.0, 1.0, 0.0
    elif i == DD_Y:
        away = 0.0, 0.0, 1.0
    elif i == DS_X:
        away = -1.0, 0.0, 0.0
    elif i == DS_Y:
        away = 0.0, 0.0, -1.0
    elif i == PANEL_TRAVEL:
        away = geo[PANEL_WAY].real, 0.0, 0.0
    elif i == PANEL_TRAVEL + 1:
        away = 0.0, 0.0, geo[PANEL_WAY + 2].real
    elif i == PANEL_TRAVEL + 2:
        away = 0.0, geo[PANEL_WAY + 1].real, 0.0
    elif i in (ROLL, PITCH, YAW, PIXEL):
        turned = p
        value = turned[i]
        turned[i] += IMAGINARY_STEP * 1j
        panel_rows(turned, geo, rows, turned_steps)
        turned[i] = value
        for r in range(3):
            for c in range(3):
                slopes[r, c] = rows[r, c].imag / IMAGINARY_STEP
        return
    across, along = _cross(steps[1], away), _cross(away, steps[0])
    for c in range(3):
        slopes[0, c] = across[c]
        slopes[1, c] = along[c]


class Data(NamedTuple):
    """The data of a fit, C-contiguous; n frames, k beads.

    Attributes:
        geometry: (n, 24) nominal source, axis, detector, u, v [mm], angle [rad], the mount's
            x and y, and the ways of axis and panel from their middles [mm]; see `SOURCE`.
        group: (n,) index of each frame's parameter set.
        pivot: 1.0 or 0.0, see the module.
        middle: (3,) point of the phantom about which it grows [mm].
        radius: (k,) [mm].
        bias: (n, k) factor of the sphere-centre bias.
        measured: (n, k, 2) pixels from the detector's center.
        whiten: (n, k, 3): rows (w0, w1; 0, w2) that turn residuals into unit variance.
        active: indices of the parameters to differentiate by.
        colmap: (groups, 28) column of each parameter or -1.
        bead_col: first column of the beads' coordinates or -1.
        terms: (n, k, 2, t) shifts by a coefficient of 1 of each term of the panel's distortion,
            whose columns are the last.
    """

    geometry: FloatArray
    group: npt.NDArray[np.int64]
    pivot: float
    middle: FloatArray
    radius: FloatArray
    bias: FloatArray
    measured: FloatArray
    whiten: FloatArray
    active: npt.NDArray[np.int64]
    colmap: npt.NDArray[np.int64]
    bead_col: int
    terms: FloatArray


@serial(error_model="numpy")
def evaluate(  # type: ignore[no-untyped-def]
    data, params, beads, panel, use, huber, want, predicted, norms, jac, hess, grad
):
    """Evaluate all observations in one pass.

    Derivatives are exact (see the module). A bead at or behind the source ends the
    evaluation at once; the arrays are then incomplete.

    Args:
        data: see `Data`.
        params: (groups, 28) values [mm, rad, 1], in the order of `told_lengths.PARAMETERS`.
        beads: (k, 3) centers in the object's frame [mm].
        panel: (t,) coefficients of the panel's distortion.
        use: (n, k) which observations count; others are predicted alone.
        huber: threshold on the whitened residual's length; inf for plain least squares.
        want: 0 cost only, 1 normal equations into hess, grad, 2 unweighted rows into jac.
        predicted: (n, k, 2) out, pixels from the detector's center.
        norms: (n, k) out: length of the whitened residual; -1 where not used.
        jac: (2 n k, columns) out when want = 2 (rows of unused observations stay zero).
        hess: (columns, columns), grad: (columns,): set to 0; out when want = 1.

    Returns:
        The cost; inf if a bead is not in front of the source.
    """
    (
        geometry,
        group,
        pivot,
        middle,
        radius,
        bias,
        measured,
        whiten,
        active,
        colmap,
        bead_col,
        terms,
    ) = data
    n_frames, n_beads = use.shape
    most = len(active) + 3
    rows, rows_slope = np.zeros((3, 3)), np.zeros((3, 3))
    columns, columns_slope = np.zeros((4, 3)), np.zeros((4, 3))
    steps = np.zeros((2, 3))
    complex_values = np.zeros(PARAMETERS, np.complex128)
    complex_geo = np.zeros(GEOMETRY, np.complex128)
    turned = np.zeros((3, 3), np.complex128)
    turned_steps = np.zeros((2, 3), np.complex128)
    now, at = np.zeros((3, 4)), np.zeros(3)
    slope, slide = np.zeros((most, 3, 4)), np.zeros((most, 3))
    cols = np.empty(most + len(panel), np.int64)
    da, db = np.empty(len(cols)), np.empty(len(cols))
    total = 0.0
    _clear(hess)
    for i in range(len(grad)):
        grad[i] = 0.0
    for f in range(n_frames):
        values, geo = params[group[f]], geometry[f]
        for i in range(PARAMETERS):
            complex_values[i] = values[i]
        for i in range(GEOMETRY):
            complex_geo[i] = geo[i]
        panel_rows(complex_values, complex_geo, turned, turned_steps)
        for c in range(3):
            for r in range(3):
                rows[r, c] = turned[r, c].real
            for r in range(2):
                steps[r, c] = turned_steps[r, c].real
        object_columns(values, geo, pivot, columns)
        grown = 1.0 + values[PHANTOM]
        for r in range(3):
            # The foot of the source's perpendicular, away from which a ball's spot is
            # displaced: where a ray along the unit normal, rows[2], meets the panel.
            at[r] = _dot(rows[r], rows[2])
            for c in range(4):
                now[r, c] = _dot(rows[r], columns[c])
            about = _dot(now[r], middle)
            now[r, 3] -= (grown - 1.0) * about
            for c in range(3):
                now[r, c] *= grown
        own = 0
        for i in active:
            if want > 0 and colmap[group[f], i] >= 0:
                object_slopes(i, values, geo, pivot, columns, columns_slope)
                panel_slopes(
                    i,
                    complex_values,
                    complex_geo,
                    steps,
                    turned,
                    turned_steps,
                    rows_slope,
                )
                for r in range(3):
                    slide[own, r] = _dot(rows_slope[r], rows[2]) + _dot(
                        rows[r], rows_slope[2]
                    )
                    for c in range(4):
                        slope[own, r, c] = _dot(rows_slope[r], columns[c]) + _dot(
                            rows[r], columns_slope[c]
                        )
                    about = _dot(slope[own, r], middle)
                    slope[own, r, 3] -= (grown - 1.0) * about
                    for c in range(3):
                        slope[own, r, c] *= grown
                        if i == PHANTOM:
                            slope[own, r, c] = now[r, c] / grown
                    if i == PHANTOM:
                        slope[own, r, 3] = -_dot(slope[own, r], middle)
                cols[own] = colmap[group[f], i]
                own += 1
        if bead_col >= 0:
            for i in range(3):
                _clear(slope[own + i])
                for r in range(3):
                    slide[own + i, r] = 0.0
                    # A bead's x changes its place by the column of x, wherever it is: a slope
                    # of the constant.
                    slope[own + i, r, 3] = now[r, i]
        for k in range(n_beads):
            x, y, z = beads[k]
            depth = now[2, 0] * x + now[2, 1] * y + now[2, 2] * z + now[2, 3]
            if depth <= 0.0:
                return np.inf
            # Project the bead's centre to (a, e), then displace it by the ball's bias.
            a = (now[0, 0] * x + now[0, 1] * y + now[0, 2] * z + now[0, 3]) / depth
            e = (now[1, 0] * x + now[1, 1] * y + now[1, 2] * z + now[1, 3]) / depth
            stretch = bias[f, k] * (radius[k] / depth) ** 2
            col = a + stretch * (a - at[0])
            row = e + stretch * (e - at[1])
            for i in range(len(panel)):
                col += panel[i] * terms[f, k, 0, i]
                row += panel[i] * terms[f, k, 1, i]
            predicted[f, k, 0] = col
            predicted[f, k, 1] = row
            if not use[f, k]:
                norms[f, k] = -1.0
                continue
            # Whiten, and weigh down what is further off than the Huber threshold.
            w0, w1, w2 = whiten[f, k]
            r0 = w0 * (col - measured[f, k, 0]) + w1 * (row - measured[f, k, 1])
            r1 = w2 * (row - measured[f, k, 1])
            length = math.sqrt(r0 * r0 + r1 * r1)
            norms[f, k] = length
            weight = 1.0
            if length <= huber:
                total += 0.5 * length * length
            else:
                total += huber * (length - 0.5 * huber)
                weight = huber / length
            if want == 0:
                continue
            m = own
            if bead_col >= 0:
                for i in range(3):
                    cols[m + i] = bead_col + 3 * k + i
                m += 3
            for j in range(m):
                d = slope[j]
                # Quotient rule: `inward` is the relative change of depth; `stretch` goes with
                # its square, over the foot that moves by `slide`.
                inward = (d[2, 0] * x + d[2, 1] * y + d[2, 2] * z + d[2, 3]) / depth
                va = (
                    d[0, 0] * x + d[0, 1] * y + d[0, 2] * z + d[0, 3]
                ) / depth - a * inward
                vb = (
                    d[1, 0] * x + d[1, 1] * y + d[1, 2] * z + d[1, 3]
                ) / depth - e * inward
                da[j] = va + stretch * (va - slide[j, 0] - 2.0 * inward * (a - at[0]))
                db[j] = vb + stretch * (vb - slide[j, 1] - 2.0 * inward * (e - at[1]))
            for i in range(len(panel)):
                da[m], db[m] = terms[f, k, 0, i], terms[f, k, 1, i]
                cols[m] = len(grad) - len(panel) + i
                m += 1
            for j in range(m):
                cj = cols[j]
                da[j] = w0 * da[j] + w1 * db[j]
                db[j] = w2 * db[j]
                if want == 2:
                    jac[2 * (f * n_beads + k), cj] = da[j]
                    jac[2 * (f * n_beads + k) + 1, cj] = db[j]
                    continue
                va, vb = weight * da[j], weight * db[j]
                grad[cj] += va * r0 + vb * r1
                for i in range(j + 1):
                    # Columns of a frame do not ascend: sets of parameters may share some.
                    hess[min(cj, cols[i]), max(cj, cols[i])] += va * da[i] + vb * db[i]
    for i in range(len(grad)):
        for j in range(i):
            hess[i, j] = hess[j, i]
    return total
