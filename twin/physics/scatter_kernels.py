"""Photons through voxels: forced interaction, forced detection, random numbers from a counter.

One history is one photon with a weight. Its first flight is forced to end inside the
object, so that no history is lost, and so is every later one; absorption lowers the
weight. From each interaction the expected signal is sent along straight lines to nodes on
the panel ("forced detection", Kalos, Nucl. Sci. Eng. 16 (1963) 111; with fixed nodes:
Poludniowski et al., Phys. Med. Biol. 54 (2009) 3847): no photon has to hit the panel by
chance. Then the photon is turned by a sampled angle.

The first interaction's numbers (place in the beam, energy, depth, material, nodes) are
points of a Sobol sequence, scrambled independently for each batch (Owen, J. Complexity 14
(1998) 466), which converges faster than random points and leaves independent batches
whose spread is the standard error. Later numbers are a mixed counter (SplitMix64: Steele,
Lea and Flood, OOPSLA 2014) that starts from the batch's key and the history's number. A
batch is summed by one thread in the order of its histories, so the image is the same for
any number of threads.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numba import prange

from flexdt.twin.attenuation.scattering import ELECTRON_KEV, HC_KEV_A
from flexdt.twin.projection.kernels.compiling import inline, kernel, parallel

SINGLE = 0
MULTIPLE = 1
NOISE = 2
"""Channels of the images: signal after one and after more interactions, variance of both."""
TALLIES = 6
"""Number of sums over the histories: photons that interact, are absorbed, escape; then
their energies [keV]."""
DIMENSIONS = 6
"""Number of random numbers of the first interaction."""
ROULETTE_WEIGHT = 0.15
"""Weight, as part of the first, below which a photon survives with the chance
weight / ROULETTE_WEIGHT."""
MAX_ORDERS = 100
"""Largest number of interactions of a photon."""

_GAMMA = np.uint64(0x9E3779B97F4A7C15)
_MIX_1 = np.uint64(0xBF58476D1CE4E5B9)
_MIX_2 = np.uint64(0x94D049BB133111EB)
_30 = np.uint64(30)
_27 = np.uint64(27)
_31 = np.uint64(31)
_11 = np.uint64(11)


@inline
def mixed(z: Any) -> Any:
    """Compute SplitMix64's finaliser: a bijection of 64 bits that mixes all."""
    z = (z ^ (z >> _30)) * _MIX_1
    z = (z ^ (z >> _27)) * _MIX_2
    return z ^ (z >> _31)


@inline
def draw(state: Any) -> Any:
    """Compute the next state of a stream, and its number in [0, 1)."""
    state = state + _GAMMA
    return state, (mixed(state) >> _11) * (1.0 / 9007199254740992.0)


@inline
def between(row: Any, at: Any) -> Any:
    """Interpolate linearly in an evenly spaced table."""
    i = min(max(int(at), 0), len(row) - 2)
    part = at - i
    return row[i] * (1.0 - part) + row[i + 1] * part


@kernel
def travel(amounts, lower, edge, p, d, mu, stop, paths):
    """Walk from p along d through the grid (Amanatides and Woo, Eurographics 1987), to an
    optical depth or, with an infinite one, to the far side, adding up path lengths.

    Args:
        amounts: (nz, ny, nx, m) float32, parts of each material's own density.
        lower, edge: (3,) the grid's corner of least x, y, z and the voxels' edges [mm].
        p, d: (3,) start, also outside the grid, and unit direction.
        mu: (m,) attenuation at one energy [1/mm]; used for `stop` alone.
        stop: optical depth at which to end; infinite: at the grid's far side.
        paths: (m,) replaced by amount times length of each material [mm]; zeros with a
            finite `stop`.

    Returns:
        Distance from p at which `stop` was reached [mm]; -1 if it was not.
    """
    materials = amounts.shape[3]
    for m in range(materials):
        paths[m] = 0.0
    # Distances at which the ray is inside the grid, slab by slab of x, y and z.
    near = 0.0
    far = np.inf
    for a in range(3):
        n = amounts.shape[2 - a]
        low = lower[a] - p[a]
        high = lower[a] + n * edge[a] - p[a]
        if abs(d[a]) < 1e-12:
            if low > 0.0 or high < 0.0:
                return -1.0
        else:
            one = low / d[a]
            other = high / d[a]
            near = max(near, min(one, other))
            far = min(far, max(one, other))
    if far <= near:
        return -1.0
    # Voxel of the entry, distance to the next plane and between planes, along x, y, z.
    nx = amounts.shape[2]
    ny = amounts.shape[1]
    nz = amounts.shape[0]
    gx = (p[0] + near * d[0] - lower[0]) / edge[0]
    gy = (p[1] + near * d[1] - lower[1]) / edge[1]
    gz = (p[2] + near * d[2] - lower[2]) / edge[2]
    i = min(max(int(gx), 0), nx - 1)
    j = min(max(int(gy), 0), ny - 1)
    k = min(max(int(gz), 0), nz - 1)
    si = 1 if d[0] > 0.0 else -1
    sj = 1 if d[1] > 0.0 else -1
    sk = 1 if d[2] > 0.0 else -1
    dx = edge[0] / max(abs(d[0]), 1e-12)
    dy = edge[1] / max(abs(d[1]), 1e-12)
    dz = edge[2] / max(abs(d[2]), 1e-12)
    tx = near + (i + 1 - gx if d[0] > 0.0 else gx - i) * dx
    ty = near + (j + 1 - gy if d[1] > 0.0 else gy - j) * dy
    tz = near + (k + 1 - gz if d[2] > 0.0 else gz - k) * dz
    here = near
    depth = 0.0
    ends = stop < np.inf
    while True:
        onward = min(tx, min(ty, tz))
        length = max(onward - here, 0.0)
        # Where a depth is to be reached, the voxel in which that happens is divided;
        # otherwise only lengths are added up, which serve any energy.
        if ends:
            local = 0.0
            for m in range(materials):
                local += amounts[k, j, i, m] * mu[m]
            if depth + local * length >= stop:
                return here + (stop - depth) / max(local, 1e-300)
            depth += local * length
        else:
            for m in range(materials):
                paths[m] += amounts[k, j, i, m] * length
        here = onward
        # Step into the neighbour whose plane comes first; ties go to x, then to y.
        if tx <= ty and tx <= tz:
            i += si
            tx += dx
            if i < 0 or i >= nx:
                return -1.0
        elif ty <= tz:
            j += sj
            ty += dy
            if j < 0 or j >= ny:
                return -1.0
        else:
            k += sk
            tz += dz
            if k < 0 or k >= nz:
                return -1.0


@inline
def depth_of(paths: Any, mu: Any) -> float:
    """Compute the optical depth: sum of path lengths [mm] times attenuation [1/mm]."""
    depth = 0.0
    for m in range(len(paths)):
        depth += paths[m] * mu[m]
    return depth


@kernel
def depth_drawn(number, depth):
    """Draw an interaction's optical depth on a path of `depth` > 0, and its weight.

    `number`: random, in [0, 1). Half of the chance is the exponential's, cut off at the
    far side; half is even, as a photon that goes on is weakened as much wherever it
    interacts. Newton's steps from 0 invert the running chance, which is concave, from
    below.
    """
    hit = -math.expm1(-depth)
    t = 0.0
    for _ in range(12):
        falling = math.exp(-t)
        chance = 0.5 * (1.0 - falling) / hit + 0.5 * t / depth
        t += (number - chance) / (0.5 * falling / hit + 0.5 / depth)
    # True density of interacting at depth t, over that of the mixture it was drawn from.
    t = min(t, depth)
    falling = math.exp(-t)
    return t, falling / (0.5 * falling / hit + 0.5 / depth)


@kernel
def chosen_material(amounts, lower, edge, p, mu, number):
    """Choose the material that a photon interacts with at p, in proportion to
    attenuation, by a number in [0, 1); returns its index.

    Args:
        amounts: density of each material relative to its own, (z, y, x, m).
        lower: corner of the grid (3,) [mm].
        edge: of a voxel (3,) [mm].
        p: position (3,) [mm].
        mu: attenuation of the materials (m,) [1/mm].
        number: random, in [0, 1).
    """
    nz, ny, nx, materials = amounts.shape
    i = min(max(int((p[0] - lower[0]) / edge[0]), 0), nx - 1)
    j = min(max(int((p[1] - lower[1]) / edge[1]), 0), ny - 1)
    k = min(max(int((p[2] - lower[2]) / edge[2]), 0), nz - 1)
    rest = 0.0
    for m in range(materials):
        rest += amounts[k, j, i, m] * mu[m]
    rest *= number
    for m in range(materials - 1):
        rest -= amounts[k, j, i, m] * mu[m]
        if rest < 0.0:
            return m
    return materials - 1


@kernel
def coherent_cosine(state, energy, cumulated, root_step):
    """Draw the angle of a coherent interaction: x^2 from the running integral of F^2,
    then Thomson's (1 + cos^2) / 2 by rejection (Persliden, Comput. Programs Biomed. 17
    (1983) 115).

    Args:
        state: of the random numbers.
        energy: of the photon [keV].
        cumulated: running integral of F^2 over x^2, at points evenly spaced in the root
            of x.
        root_step: spacing of its table.

    Returns:
        The next state of the random numbers, and the cosine.
    """
    # x = sin(angle / 2) E / hc; the tables are evenly spaced in sqrt(x), finest near 0, where
    # form factors fall. Backward (cosine -1) is x = E / hc, beyond which nothing is drawn.
    greatest = energy / HC_KEV_A
    last = between(cumulated, math.sqrt(greatest) / root_step)
    while True:
        state, number = draw(state)
        wanted = number * last
        low = 0
        high = len(cumulated) - 1
        while high - low > 1:
            middle = (low + high) // 2
            if cumulated[middle] <= wanted:
                low = middle
            else:
                high = middle
        part = (wanted - cumulated[low]) / max(cumulated[high] - cumulated[low], 1e-300)
        x2_low = (low * root_step) ** 4
        x2_high = (high * root_step) ** 4
        x2 = x2_low + part * (x2_high - x2_low)
        cosine = 1.0 - 2.0 * min(x2 / (greatest * greatest), 1.0)
        state, number = draw(state)
        if 2.0 * number <= 1.0 + cosine * cosine:
            return state, cosine


@kernel
def incoherent_cosine(state, energy, shell, root_step):
    """Draw the angle of an incoherent interaction, by rejection from the even distribution:
    Klein-Nishina, at most 1 here, and S over its greatest value. Half of the trials or more
    succeed below 250 keV.

    Args:
        state: of the random stream.
        energy: of the photon [keV].
        shell: (e,) S, the incoherent scattering function.
        root_step: step of its table, in the root of x.

    Returns the stream's new state, and the cosine.
    """
    most = shell[len(shell) - 1]
    while True:
        state, number = draw(state)
        cosine = 2.0 * number - 1.0
        k = 1.0 / (1.0 + energy / ELECTRON_KEV * (1.0 - cosine))
        state, number = draw(state)
        if 2.0 * number > k * k * (k + 1.0 / k - 1.0 + cosine * cosine):
            continue
        x = energy / HC_KEV_A * math.sqrt(0.5 * (1.0 - cosine))
        state, number = draw(state)
        if number * most <= between(shell, math.sqrt(x) / root_step):
            return state, cosine


@kernel
def turn(d, cosine, azimuth):
    """Turn the unit vector d by a polar angle and an azimuth, in place.

    Args:
        d: unit vector (3,), changed.
        cosine: of the polar angle.
        azimuth: [rad].
    """
    sine = math.sqrt(max(0.0, 1.0 - cosine * cosine))
    a = sine * math.cos(azimuth)
    b = sine * math.sin(azimuth)
    x = d[0]
    y = d[1]
    z = d[2]
    # Along z the azimuth has no zero of its own, and q below would be lost to rounding.
    if abs(z) > 0.9999:
        d[0] = a
        d[1] = b
        d[2] = math.copysign(cosine, z)
    else:
        q = math.sqrt(1.0 - z * z)
        d[0] = cosine * x + (a * x * z - b * y) / q
        d[1] = cosine * y + (a * y * z + b * x) / q
        d[2] = cosine * z - a * q
    norm = 1.0 / math.sqrt(d[0] * d[0] + d[1] * d[1] + d[2] * d[2])
    d[0], d[1], d[2] = d[0] * norm, d[1] * norm, d[2] * norm


@kernel
def detect(
    amounts,
    lower,
    edge,
    nodes,
    normal,
    per_open,
    total,
    first_keV,
    step_keV,
    form,
    shell,
    root_step,
    response,
    spread,
    p,
    d,
    energy,
    mu,
    m,
    weight,
    start,
    fan,
    v,
    paths,
    image,
    channel,
):
    """Send the expected signal of an interaction at p to `fan` of the nodes, coherent and
    incoherent; nodes that see p from behind the panel get nothing.

    Every len(nodes) / fan-th node is taken from `start` on, so each is as likely as any
    other.

    Args:
        amounts, lower, edge: as for `travel`.
        nodes, normal, per_open: as for `histories`.
        total, first_keV, step_keV, form, shell, root_step: the cross-sections.
        response, spread: (e,) signal and variance of a photon, by energy.
        p: (3,) place of the interaction [mm].
        d: (3,) direction of the photon before it.
        energy: of the photon before it [keV].
        mu: (materials,) attenuations at that energy.
        m: number of the material.
        weight: everything but the differential cross-section in units of the attenuation
            coefficient, the attenuation on the way and the node's solid angle.
        start: first node.
        fan: number of nodes.
        v: (3,) room.
        paths: (materials,) room.
        image: (n, 3) added to.
        channel: of the image, SINGLE or MULTIPLE; the variance goes to NOISE.
    """
    number = len(nodes)
    share = weight * number / fan / mu[m]
    from_bin = (energy - first_keV) / step_keV
    same_signal = between(response, from_bin)
    same_spread = between(spread, from_bin)
    for f in range(fan):
        node = (start + f * number // fan) % number
        v[0] = nodes[node, 0] - p[0]
        v[1] = nodes[node, 1] - p[1]
        v[2] = nodes[node, 2] - p[2]
        square = v[0] * v[0] + v[1] * v[1] + v[2] * v[2]
        scale = 1.0 / math.sqrt(square)
        v[0], v[1], v[2] = v[0] * scale, v[1] * scale, v[2] * scale
        slant = v[0] * normal[0] + v[1] * normal[1] + v[2] * normal[2]
        if slant <= 0.0:  # the interaction is behind the panel
            continue
        cosine = min(max(d[0] * v[0] + d[1] * v[1] + d[2] * v[2], -1.0), 1.0)
        x = energy / HC_KEV_A * math.sqrt(0.5 * (1.0 - cosine))
        column = math.sqrt(x) / root_step
        k = 1.0 / (1.0 + energy / ELECTRON_KEV * (1.0 - cosine))
        coherent = 0.5 * (1.0 + cosine * cosine) * between(form[m], column)
        incoherent = (
            0.5
            * k
            * k
            * (k + 1.0 / k - 1.0 + cosine * cosine)
            * between(shell[m], column)
        )
        # A coherent photon keeps its energy on the way to the node, an incoherent one has
        # k of it and is weakened more: one walk gives the lengths for both.
        travel(amounts, lower, edge, p, v, mu, np.inf, paths)
        to_bin = (energy * k - first_keV) / step_keV
        depth = 0.0
        softer = 0.0
        for other in range(len(paths)):
            if paths[other] > 0.0:
                depth += paths[other] * mu[other]
                softer += paths[other] * between(total[other], to_bin)
        solid = share * slant / square * per_open[node]
        a = solid * coherent * math.exp(-depth)
        if to_bin >= 0.0:
            b = solid * incoherent * math.exp(-softer)
        else:
            b = 0.0
        image[node, channel] += a * same_signal + b * between(response, to_bin)
        image[node, 2] += a * same_spread + b * between(spread, to_bin)


@parallel
def histories(
    points,
    first,
    keys,
    fans,
    orders,
    source,
    corner,
    along_u,
    along_v,
    normal,
    lit,
    nodes,
    per_open,
    amounts,
    lower,
    edge,
    first_keV,
    step_keV,
    total,
    coherent,
    incoherent,
    root_step,
    form,
    shell,
    cumulated,
    bins,
    chances,
    photons,
    response,
    spread,
    images,
    tallies,
):
    """Follow histories in each batch and add their signals to the images.

    The first interaction is forced, as is each later one; absorption lowers the weight,
    and below `ROULETTE_WEIGHT` histories are ended by chance. A ray that misses the
    object counts nothing.

    Args:
        points: (b, n, DIMENSIONS) numbers of the first interactions of each batch's n
            histories.
        first: number of the first history.
        keys: (b,) uint64, the batches' streams.
        fans: (2,) nodes that the first interaction and each later one send to.
        orders: interactions at most.
        source: (3,) focal spot [mm].
        corner, along_u, along_v, normal: (3,) of the panel's plane: a corner of the lit
            rectangle, its edges [mm], unit vector away from the source.
        lit: area of the rectangle [mm2].
        nodes, per_open: (n, 3) [mm] and (n,) one over the open beam there [mm2 sr].
        amounts, lower, edge: as for `travel`.
        first_keV to cumulated: the cross-sections.
        bins, chances: (s,) the spectrum's bins and the running chances to draw them.
        photons: (s,) photons of each in a history of the open beam's signal, over that
            chance.
        response, spread: (e,) signal and variance of a photon, by energy.
        images: (b, n, 3) float64, added to, in units of the open beam's signal for one
            history.
        tallies: (b, TALLIES) float64, added to.
    """
    materials = amounts.shape[3]
    number = len(nodes)
    for batch in prange(len(images)):
        image = images[batch]
        tally = tallies[batch]
        mu = np.empty(materials)
        paths = np.empty(materials)
        v = np.empty(3)
        p = np.empty(3)
        d = np.empty(3)
        # `scale` is what the history stands for in the open beam and stays; `weight`
        # begins at 1 and changes with absorption and forced flights: the roulette
        # compares it with one number.
        for history in range(points.shape[1]):
            sobol = points[batch, history]
            # An even point of the lit rectangle: its solid angle is the history's first weight.
            for a in range(3):
                d[a] = (
                    corner[a] + sobol[0] * along_u[a] + sobol[1] * along_v[a] - source[a]
                )
                p[a] = source[a]
            square = d[0] * d[0] + d[1] * d[1] + d[2] * d[2]
            scale = 1.0 / math.sqrt(square)
            for a in range(3):
                d[a] *= scale
            slant = d[0] * normal[0] + d[1] * normal[1] + d[2] * normal[2]
            at = min(np.searchsorted(chances, sobol[2], side="right"), len(bins) - 1)
            energy = first_keV + bins[at] * step_keV
            for m in range(materials):
                mu[m] = between(total[m], (energy - first_keV) / step_keV)
            travel(amounts, lower, edge, p, d, mu, np.inf, paths)
            depth = depth_of(paths, mu)
            if depth < 1e-9:  # the ray misses the object: no history
                continue
            stop, gain = depth_drawn(sobol[3], depth)
            scale = lit * slant / square * photons[at] * gain
            weight = 1.0
            state = mixed(keys[batch] + np.uint64(first + history) * _GAMMA)
            tally[0] += scale
            tally[3] += scale * energy
            for order in range(orders):
                # A hair less than drawn: rounding must not carry the end out at the far side.
                distance = travel(
                    amounts, lower, edge, p, d, mu, stop * (1.0 - 1e-12), paths
                )
                if distance < 0.0:
                    break
                for a in range(3):
                    p[a] += distance * d[a]
                state, pick = draw(state)
                state, turned = draw(state)
                if order == 0:
                    pick = sobol[4]
                    turned = sobol[5]
                m = chosen_material(amounts, lower, edge, p, mu, pick)
                detect(
                    amounts,
                    lower,
                    edge,
                    nodes,
                    normal,
                    per_open,
                    total,
                    first_keV,
                    step_keV,
                    form,
                    shell,
                    root_step,
                    response,
                    spread,
                    p,
                    d,
                    energy,
                    mu,
                    m,
                    scale * weight,
                    min(int(turned * number), number - 1),
                    fans[min(order, 1)],
                    v,
                    paths,
                    image,
                    min(order, 1),
                )
                if order == orders - 1:
                    break
                # Absorption is a loss of weight; the rest goes on, coherent or incoherent.
                from_bin = (energy - first_keV) / step_keV
                elastic = between(coherent[m], from_bin)
                inelastic = between(incoherent[m], from_bin)
                survives = min((elastic + inelastic) / mu[m], 1.0)
                tally[1] += scale * weight * (1.0 - survives)
                tally[4] += scale * weight * (1.0 - survives) * energy
                weight *= survives
                state, pick = draw(state)
                if pick * (elastic + inelastic) < elastic:
                    state, cosine = coherent_cosine(
                        state, energy, cumulated[m], root_step
                    )
                else:
                    state, cosine = incoherent_cosine(state, energy, shell[m], root_step)
                    before = energy
                    energy /= 1.0 + energy / ELECTRON_KEV * (1.0 - cosine)
                    tally[4] += scale * weight * (before - energy)
                if energy < first_keV:  # below the tables a photon stays where it is
                    tally[1] += scale * weight
                    tally[4] += scale * weight * energy
                    break
                state, pick = draw(state)
                turn(d, cosine, 2.0 * math.pi * pick)
                for m in range(materials):
                    mu[m] = between(total[m], (energy - first_keV) / step_keV)
                travel(amounts, lower, edge, p, d, mu, np.inf, paths)
                depth = depth_of(paths, mu)
                tally[2] += scale * weight * math.exp(-depth)
                tally[5] += scale * weight * math.exp(-depth) * energy
                if depth < 1e-9:
                    break
                state, pick = draw(state)
                stop, gain = depth_drawn(pick, depth)
                weight *= gain
                # Light photons are ended by chance, and those that survive weigh more:
                # the sum is the same on average, and no time is spent on light photons.
                if weight < ROULETTE_WEIGHT:
                    state, pick = draw(state)
                    if pick * ROULETTE_WEIGHT >= weight:
                        break
                    weight = ROULETTE_WEIGHT
