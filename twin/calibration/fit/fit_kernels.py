"""Compiled kernels of the fit: residuals, analytic Jacobian, normal equations.

For any subset of the seventeen parameters, and for the beads themselves, they compute what
`Poses.cone_vec(parameters).project_points(beads)` computes. That makes this the second place where
offsets meet geometry: tests/twin/calibration/test_kernel_binding.py compares values and
derivatives of all seventeen with `Poses.cone_vec`, and fails if any one sign here is flipped.
`fit.problem` builds and checks the arguments.

Forward model of frame n and bead b, in the world frame: q = c + T R (b + m - tau),
c = O + dO + pivot * tau (pivot 1: eq. 5.4 as printed; 0: R(b - tau) + O), R clockwise from above by
alpha + angle_scale * phi, T the axis tilt, m where a stage on the turntable stands. With w = q - S,
g = D - S and the pixel steps u, v the bead's centre is projected to column w.P / w.n and row
w.Q / w.n from the detector's centre, P = v x g, Q = g x u, n = u x v: Cramer's rule, valid for any
u, v. The spot of a ball is displaced from the projection of its centre:
spot = a + bias * (r / depth)^2 (a - foot), bias 1 for the outline's centre, 0.8 for the
chord-weighted centroid, 0 for points (calibration.md, "Images").

Derivatives: a = w.P / w.n, so da = (dw.P + w.dP - a (dw.n + w.dn)) / w.n, and the same with Q for
the row. A parameter moves the bead (dw), the source and with it w and g, or the detector (dP, dQ,
dn); the four kinds below say which, so that the inner loop computes only what is not zero.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from flexdt.twin.geometry.conventions import FloatArray
from flexdt.twin.projection.kernels.compiling import linked, serial

PARAMETERS = 17
# Places of the parameters in a row of `params`: the order of `offsets.NAMES`. Unity's axes are in
# the names: _x is the world's x, _y its z, _z its y. numba compiles globals in as constants.
DO_X, DO_Y, DO_Z, ALPHA, TAU_X, TAU_Z, DD_X, DD_Y, DD_Z, DS_X, DS_Y = range(11)
ROLL, PITCH, YAW, TILT_X, TILT_Z, ANGLE_SCALE = range(11, PARAMETERS)
# First columns of a row of `geometry`.
SOURCE, AXIS, DETECTOR, U, V, ANGLE, MOUNT = 0, 3, 6, 9, 12, 15, 16
# How a parameter acts on w and on P, Q, n (see `evaluate`).
_CONSTANT = 0  # adds the same vector to w for every bead
_LINEAR = 1  # adds a matrix times (b - tau) to w
_DETECTOR = 2  # changes P, Q and n alone
_SOURCE = 3  # adds a constant to w and changes P, Q and n


@linked(forceinline=True)
def _cross(ax, ay, az, bx, by, bz):  # type: ignore[no-untyped-def]
    return ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx


@linked
def _rodrigues(axis, angle, vector, out):  # type: ignore[no-untyped-def]
    """Turn `vector` about the direction `axis` by `angle` into `out`, which may be itself."""
    x, y, z = axis[0], axis[1], axis[2]
    length = math.sqrt(x * x + y * y + z * z)
    x, y, z = x / length, y / length, z / length
    c, s = math.cos(angle), math.sin(angle)
    cx, cy, cz = _cross(x, y, z, vector[0], vector[1], vector[2])
    dot = x * vector[0] + y * vector[1] + z * vector[2]
    a, b, d = vector[0], vector[1], vector[2]
    out[0] = c * a + s * cx + (1.0 - c) * dot * x
    out[1] = c * b + s * cy + (1.0 - c) * dot * y
    out[2] = c * d + s * cz + (1.0 - c) * dot * z


@linked
def _turned(u, v, p, tu, tv, axes):  # type: ignore[no-untyped-def]
    """Detector steps after yaw, pitch, roll, as `conventions.turn_detector` has them.

    `axes` gets the unit axes of roll, pitch and yaw, in this order, as they stand after the turns:
    the derivative of a step with respect to an angle is its axis times the step.
    """
    normal = np.empty(3)
    _rodrigues(v, p[YAW], u, tu)
    _rodrigues(tu, p[PITCH], v, tv)
    lu = math.sqrt(tu[0] * tu[0] + tu[1] * tu[1] + tu[2] * tu[2])
    lv = math.sqrt(v[0] * v[0] + v[1] * v[1] + v[2] * v[2])
    for i in range(3):
        axes[1, i] = tu[i] / lu
        axes[2, i] = v[i] / lv
    normal[0], normal[1], normal[2] = _cross(tu[0], tu[1], tu[2], tv[0], tv[1], tv[2])
    ln = math.sqrt(normal[0] ** 2 + normal[1] ** 2 + normal[2] ** 2)
    for i in range(3):
        axes[0, i] = normal[i] / ln
    _rodrigues(normal, p[ROLL], tu, tu)
    _rodrigues(normal, p[ROLL], tv, tv)


class Data(NamedTuple):
    """What a fit is made from, C-contiguous; n frames, k beads.

    Attributes:
        geometry: (n, 18) nominal source, axis, detector, u, v [mm], angle [rad] and the mount's x
            and y [mm]; see `SOURCE`.
        group: (n,) index of each frame's parameter set.
        pivot: 1.0 or 0.0, see the module.
        radius: (k,) [mm].
        bias: (n, k) factor of the sphere-centre bias.
        measured: (n, k, 2) pixels from the detector's centre.
        whiten: (n, k, 3): rows (w0, w1; 0, w2) that turn residuals into unit variance.
        active: indices of the parameters whose derivatives are wanted.
        colmap: (groups, 17) column of each parameter or -1.
        bead_col: first column of the beads' coordinates or -1.
    """

    geometry: FloatArray
    group: npt.NDArray[np.int64]
    pivot: float
    radius: FloatArray
    bias: FloatArray
    measured: FloatArray
    whiten: FloatArray
    active: npt.NDArray[np.int64]
    colmap: npt.NDArray[np.int64]
    bead_col: int


@serial
def evaluate(  # type: ignore[no-untyped-def]
    data, params, beads, use, huber, want, predicted, norms, jac, hess, grad
):
    """One pass over all observations.

    Args:
        data: see `Data`.
        params: (groups, 17) values [mm, rad], in the order of `offsets.NAMES`.
        beads: (k, 3) centres in the object's frame [mm].
        use: (n, k) which observations count.
        huber: threshold on the whitened residual's length; inf for plain least squares.
        want: 0 cost only, 1 normal equations into hess, grad, 2 unweighted rows into jac.
        predicted: (n, k, 2) out.
        norms: (n, k) out: length of the whitened residual; -1 where not used.
        jac: (2 n k, columns) out when want = 2 (rows of unused observations stay zero).
        hess: (columns, columns), grad: (columns,): out when want = 1, upper triangle.

    Returns:
        The cost; inf if a bead is not in front of the source.
    """
    geometry, group, pivot, radius, bias, measured, whiten, active, colmap, bead_col = data
    n_frames, n_beads = use.shape
    na = active.shape[0]
    kind = np.empty(na, np.int64)
    turning = False
    for j in range(na):
        i = active[j]
        if i in (DS_X, DS_Y):
            kind[j] = _SOURCE
        elif DD_X <= i <= DD_Z or ROLL <= i <= YAW:
            kind[j] = _DETECTOR
            # The axes of turning are needed for a derivative even where all turns are zero.
            turning = turning or (want > 0 and i >= ROLL)
        elif i <= DO_Z or i in (TAU_X, TAU_Z):
            kind[j] = _CONSTANT
        else:
            kind[j] = _LINEAR
    const = np.zeros((na, 3))
    linear = np.zeros((na, 3, 3))
    dp = np.zeros((na, 3))
    dq = np.zeros((na, 3))
    dn = np.zeros((na, 3))
    dfoot = np.zeros((na, 2))
    tr = np.empty((3, 3))
    tilt = np.empty((3, 3))
    rot = np.zeros((3, 3))
    drot = np.zeros((3, 3))
    s = np.empty(3)
    c = np.empty(3)
    g = np.empty(3)
    u = np.empty(3)
    v = np.empty(3)
    axes = np.zeros((3, 3))
    w = np.empty(3)
    b = np.empty(3)
    da = np.empty(na + 3)
    db = np.empty(na + 3)
    cols = np.empty(na + 3, np.int64)
    local = np.zeros((na, na))
    local_grad = np.zeros(na)
    rot[2, 2] = 1.0
    total = 0.0
    if want == 1:
        hess[:] = 0.0
        grad[:] = 0.0

    for f in range(n_frames):
        p = params[group[f]]
        geo = geometry[f]
        # The frame's geometry with its offsets: source s, pivot c, and g from source to detector.
        s[0] = geo[SOURCE] + p[DS_X]
        s[1] = geo[SOURCE + 1]
        s[2] = geo[SOURCE + 2] + p[DS_Y]
        c[0] = geo[AXIS] + p[DO_X] + pivot * p[TAU_X]
        c[1] = geo[AXIS + 1] + p[DO_Z] + pivot * p[TAU_Z]
        c[2] = geo[AXIS + 2] + p[DO_Y]
        g[0] = geo[DETECTOR] + p[DD_X] - s[0]
        g[1] = geo[DETECTOR + 1] + p[DD_Z] - s[1]
        g[2] = geo[DETECTOR + 2] + p[DD_Y] - s[2]
        for i in range(3):
            u[i] = geo[U + i]
            v[i] = geo[V + i]
        tilted = p[ROLL] != 0.0 or p[PITCH] != 0.0 or p[YAW] != 0.0
        if tilted or turning:
            _turned(geo[U : U + 3], geo[V : V + 3], p, u, v, axes)
        px, py, pz = _cross(v[0], v[1], v[2], g[0], g[1], g[2])
        qx, qy, qz = _cross(g[0], g[1], g[2], u[0], u[1], u[2])
        nx, ny, nz = _cross(u[0], u[1], u[2], v[0], v[1], v[2])
        pixel2 = math.sqrt(nx * nx + ny * ny + nz * nz)
        # Foot of the perpendicular from the source, in pixels from the detector's centre.
        foot_a = (nx * px + ny * py + nz * pz) / (pixel2 * pixel2)
        foot_b = (nx * qx + ny * qy + nz * qz) / (pixel2 * pixel2)
        # R turns clockwise seen from above; drot is its derivative with respect to the angle.
        angle = p[ALPHA] + p[ANGLE_SCALE] * geo[ANGLE]
        ca, sa = math.cos(angle), math.sin(angle)
        rot[0, 0] = ca
        rot[0, 1] = sa
        rot[1, 0] = -sa
        rot[1, 1] = ca
        drot[0, 0] = -sa
        drot[0, 1] = ca
        drot[1, 0] = -ca
        drot[1, 1] = -sa
        # T = Ry(axis_tilt_z) Rx(axis_tilt_x), in the world's axes.
        cx, sx = math.cos(p[TILT_X]), math.sin(p[TILT_X])
        cz, sz = math.cos(p[TILT_Z]), math.sin(p[TILT_Z])
        tilt[0, 0], tilt[0, 1], tilt[0, 2] = cz, sz * sx, sz * cx
        tilt[1, 0], tilt[1, 1], tilt[1, 2] = 0.0, cx, -sx
        tilt[2, 0], tilt[2, 1], tilt[2, 2] = -sz, cz * sx, cz * cx
        for i in range(3):
            for k in range(3):
                tr[i, k] = tilt[i, 0] * rot[0, k] + tilt[i, 1] * rot[1, k] + tilt[i, 2] * rot[2, k]

        if want > 0:
            for j in range(na):
                i = active[j]
                cols[j] = colmap[group[f], i]
                if i <= DO_Z:
                    const[j, :] = 0.0
                    const[j, 0 if i == DO_X else (2 if i == DO_Y else 1)] = 1.0
                elif i in (ALPHA, ANGLE_SCALE):
                    scale = 1.0 if i == ALPHA else geo[ANGLE]
                    for r in range(3):
                        for k in range(3):
                            linear[j, r, k] = scale * (
                                tilt[r, 0] * drot[0, k] + tilt[r, 1] * drot[1, k]
                            )
                elif i in (TAU_X, TAU_Z):
                    k = i - TAU_X
                    for r in range(3):
                        const[j, r] = -tr[r, k]
                    const[j, k] += pivot
                elif DD_X <= i <= DS_Y:
                    # A step of the detector along e adds e to g, one of the source subtracts it,
                    # from w as well: P = v x g and Q = g x u follow, n stays.
                    sign = 1.0 if i <= DD_Z else -1.0
                    ex = sign if i in (DD_X, DS_X) else 0.0
                    ey = sign if i == DD_Z else 0.0
                    ez = sign if i in (DD_Y, DS_Y) else 0.0
                    const[j, 0], const[j, 1], const[j, 2] = ex, ey, ez
                    dp[j, 0], dp[j, 1], dp[j, 2] = _cross(v[0], v[1], v[2], ex, ey, ez)
                    dq[j, 0], dq[j, 1], dq[j, 2] = _cross(ex, ey, ez, u[0], u[1], u[2])
                    dn[j, :] = 0.0
                elif i <= YAW:
                    t = axes[i - ROLL]
                    dux, duy, duz = _cross(t[0], t[1], t[2], u[0], u[1], u[2])
                    dvx, dvy, dvz = _cross(t[0], t[1], t[2], v[0], v[1], v[2])
                    dp[j, 0], dp[j, 1], dp[j, 2] = _cross(dvx, dvy, dvz, g[0], g[1], g[2])
                    dq[j, 0], dq[j, 1], dq[j, 2] = _cross(g[0], g[1], g[2], dux, duy, duz)
                    ax, ay, az = _cross(dux, duy, duz, v[0], v[1], v[2])
                    bx, by, bz = _cross(u[0], u[1], u[2], dvx, dvy, dvz)
                    dn[j, 0], dn[j, 1], dn[j, 2] = ax + bx, ay + by, az + bz
                else:
                    # T = Ry(tz) Rx(tx): turning about Ry(tz) x, or about y.
                    tx, ty, tz = 0.0, 1.0, 0.0
                    if i == TILT_X:
                        tx, ty, tz = cz, 0.0, -sz
                    for k in range(3):
                        ax, ay, az = _cross(tx, ty, tz, tr[0, k], tr[1, k], tr[2, k])
                        linear[j, 0, k], linear[j, 1, k], linear[j, 2, k] = ax, ay, az
                if DD_X <= i <= YAW:  # the foot moves with source and detector only
                    dfoot[j, 0] = (
                        dn[j, 0] * px + dn[j, 1] * py + dn[j, 2] * pz
                        + nx * dp[j, 0] + ny * dp[j, 1] + nz * dp[j, 2]
                    ) / (pixel2 * pixel2)  # fmt: skip
                    dfoot[j, 1] = (
                        dn[j, 0] * qx + dn[j, 1] * qy + dn[j, 2] * qz
                        + nx * dq[j, 0] + ny * dq[j, 1] + nz * dq[j, 2]
                    ) / (pixel2 * pixel2)  # fmt: skip

        for k in range(n_beads):
            b[0] = beads[k, 0] + geo[MOUNT] - p[4]
            b[1] = beads[k, 1] + geo[MOUNT + 1] - p[5]
            b[2] = beads[k, 2]
            for i in range(3):
                w[i] = tr[i, 0] * b[0] + tr[i, 1] * b[1] + tr[i, 2] * b[2] + c[i] - s[i]
            # Project the bead's centre to (a, e), then displace it by the ball's bias.
            depth = w[0] * nx + w[1] * ny + w[2] * nz
            if depth <= 0.0:
                return np.inf
            inv = 1.0 / depth
            a = (w[0] * px + w[1] * py + w[2] * pz) * inv
            e = (w[0] * qx + w[1] * qy + w[2] * qz) * inv
            ratio = radius[k] * pixel2 * inv
            stretch = bias[f, k] * ratio * ratio
            col = a + stretch * (a - foot_a)
            row = e + stretch * (e - foot_b)
            predicted[f, k, 0] = col
            predicted[f, k, 1] = row
            if not use[f, k]:
                norms[f, k] = -1.0
                continue
            # Whiten, and weigh down what is further off than the Huber threshold.
            w0, w1, w2 = whiten[f, k, 0], whiten[f, k, 1], whiten[f, k, 2]
            r0 = col - measured[f, k, 0]
            r1 = row - measured[f, k, 1]
            r0 = w0 * r0 + w1 * r1
            r1 = w2 * r1
            length2 = r0 * r0 + r1 * r1
            length = math.sqrt(length2)
            norms[f, k] = length
            weight = 1.0
            if length <= huber:
                total += 0.5 * length2
            else:
                total += huber * (length - 0.5 * huber)
                weight = huber / length
            if want == 0:
                continue
            # Gradients of column and row with respect to w.
            pax, pay, paz = (px - a * nx) * inv, (py - a * ny) * inv, (pz - a * nz) * inv
            qbx, qby, qbz = (qx - e * nx) * inv, (qy - e * ny) * inv, (qz - e * nz) * inv
            for j in range(na):
                t = kind[j]
                dwx, dwy, dwz = 0.0, 0.0, 0.0
                if t == _LINEAR:
                    dwx = linear[j, 0, 0] * b[0] + linear[j, 0, 1] * b[1] + linear[j, 0, 2] * b[2]
                    dwy = linear[j, 1, 0] * b[0] + linear[j, 1, 1] * b[1] + linear[j, 1, 2] * b[2]
                    dwz = linear[j, 2, 0] * b[0] + linear[j, 2, 1] * b[1] + linear[j, 2, 2] * b[2]
                elif t != _DETECTOR:
                    dwx, dwy, dwz = const[j, 0], const[j, 1], const[j, 2]
                va = dwx * pax + dwy * pay + dwz * paz
                vb = dwx * qbx + dwy * qby + dwz * qbz
                wn = 0.0
                if t >= _DETECTOR:
                    wn = w[0] * dn[j, 0] + w[1] * dn[j, 1] + w[2] * dn[j, 2]
                    va += inv * (w[0] * dp[j, 0] + w[1] * dp[j, 1] + w[2] * dp[j, 2] - a * wn)
                    vb += inv * (w[0] * dq[j, 0] + w[1] * dq[j, 1] + w[2] * dq[j, 2] - e * wn)
                if stretch > 0.0:
                    grow = -2.0 * stretch * inv * (dwx * nx + dwy * ny + dwz * nz + wn)
                    va += stretch * (va - dfoot[j, 0]) + grow * (a - foot_a)
                    vb += stretch * (vb - dfoot[j, 1]) + grow * (e - foot_b)
                da[j] = va
                db[j] = vb
            m = na
            if bead_col >= 0:
                for i in range(3):
                    cols[na + i] = bead_col + 3 * k + i
                    va = tr[0, i] * pax + tr[1, i] * pay + tr[2, i] * paz
                    vb = tr[0, i] * qbx + tr[1, i] * qby + tr[2, i] * qbz
                    grow = tr[0, i] * nx + tr[1, i] * ny + tr[2, i] * nz
                    grow *= -2.0 * stretch * inv
                    da[na + i] = (1.0 + stretch) * va + grow * (a - foot_a)
                    db[na + i] = (1.0 + stretch) * vb + grow * (e - foot_b)
                m = na + 3
            if want == 1:
                # Parameter by parameter into `local`, spread when the group changes; the few
                # entries with a bead's coordinates go into `hess` directly.
                for j in range(m):
                    da[j] = w0 * da[j] + w1 * db[j]
                    db[j] = w2 * db[j]
                for j in range(na):
                    va = weight * da[j]
                    vb = weight * db[j]
                    local_grad[j] += va * r0 + vb * r1
                    for i in range(j, na):
                        local[j, i] += va * da[i] + vb * db[i]
                for j in range(na, m):
                    va = weight * da[j]
                    vb = weight * db[j]
                    cj = cols[j]
                    grad[cj] += va * r0 + vb * r1
                    for i in range(na):
                        if cols[i] >= 0:  # parameters come before beads
                            hess[cols[i], cj] += va * da[i] + vb * db[i]
                    for i in range(j, m):
                        hess[cj, cols[i]] += va * da[i] + vb * db[i]
            else:
                row_index = 2 * (f * n_beads + k)
                for j in range(m):
                    if cols[j] >= 0:
                        jac[row_index, cols[j]] = w0 * da[j] + w1 * db[j]
                        jac[row_index + 1, cols[j]] = w2 * db[j]

        # Frames of a group share their columns: add up until the group changes.
        last = f == n_frames - 1 or group[f + 1] != group[f]
        if want == 1 and last:
            for j in range(na):
                cj = colmap[group[f], active[j]]
                if cj >= 0:
                    grad[cj] += local_grad[j]
                    for i in range(j, na):
                        ci = colmap[group[f], active[i]]
                        if ci >= 0:
                            hess[min(ci, cj), max(ci, cj)] += local[j, i]
            local[:] = 0.0
            local_grad[:] = 0.0
    return total
