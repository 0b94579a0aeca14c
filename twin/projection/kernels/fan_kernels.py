"""Exact Siddon for complete fans of rays at once, and its transpose: the fast path of the
projector.

The rays of a fan leave the focal spot in (nearly) one plane parallel to z, so that seen along z
they (nearly) share one line through the voxel columns; `fan_walk_kernels` carries them along it
together. Fans for which that cannot work (source or pixels inside the box, rays along a voxel
plane) go ray by ray. This module deals out jobs to workers and moves pixels; `fan_plan` cuts
the fans. The drawing in docs/performance.md shows fan, walk and schedule.
"""

from __future__ import annotations

import numpy as np
from numba import prange

from flexdt.twin.projection.kernels import (
    fan_rays_kernels,
    fan_types,
    fan_walk_kernels,
    siddon_kernels,
)
from flexdt.twin.projection.kernels.compiling import (
    count_one,
    fetch_next,
    inline,
    kernel,
    parallel,
    sources,
    wait_until,
)
from flexdt.twin.projection.kernels.fan_rays_kernels import (
    collect,
    columns_of,
    describe,
    make_collected,
    make_rays,
    make_work,
    oriented,
    sort_by_slope,
    start,
)
from flexdt.twin.projection.kernels.fan_types import Box
from flexdt.twin.projection.kernels.fan_walk_kernels import ZERO, walk
from flexdt.twin.projection.kernels.siddon_kernels import open_column, walk_ray

SOURCES = sources(fan_rays_kernels, fan_types, fan_walk_kernels, siddon_kernels)


@inline
def carry_fan(box, g, grid, collected, rays, work, n, buffer, transposed):
    """Add the integrals of a fan of collected rays to the job's buffer; transposed, add
    the buffer's values to the voxels.

    A fan that cannot be walked together is walked ray by ray; rays that miss the box
    change nothing.

    Args:
        box: voxels; transposed, changed in place.
        g: (12,) source, first pixel minus source, u, v [voxels].
        grid: the box as seen along the fan, from `oriented`.
        collected: n collected rays.
        rays: room for them, sorted.
        work: room for the walk.
        n: number of rays.
        buffer: values of the job's pixels; changed in place unless transposed.
        transposed: see above.
    """
    fan = describe(grid, collected, n)
    if not fan.together:
        # Source or pixels inside the box, or rays along a voxel plane: each ray on its own.
        for q in range(n):
            # As integers: single rays come with such, and one form of `walk_ray` serves both.
            at = collected.slot[q]
            r = np.int64(collected.row[q])
            c = np.int64(collected.column[q])
            if not transposed:
                buffer[at] += walk_ray(box, g, r, c, ZERO, False)
            # Single rays are dear, and a pixel of 0 adds nothing.
            elif buffer[at] != ZERO:
                walk_ray(box, g, r, c, buffer[at], True)
        return
    # By slope, rays that cross a plane one after the other lie side by side in memory.
    count = sort_by_slope(grid, fan, collected, rays, work.bins, n)
    if count == 0 or fan.j1 <= fan.j0:
        return
    start(grid, fan, rays, work, count)
    # The walk adds up pieces in units of the ray; its length in mm enters once, here.
    acc = rays.acc
    slot = rays.slot
    length = rays.length
    if transposed:
        for q in range(count):
            acc[q] = buffer[slot[q]] * length[q]
    walk(box.flat, box.spans, grid, fan, rays, work, count, transposed)
    if not transposed:
        for q in range(count):
            buffer[slot[q]] += acc[q] * length[q]


@kernel
def put(image, buffer, starts, ends, width, top, bottom, share):
    """Copy a job's buffer, times `share`, into its columns of an image; zeros outside its rows.

    `image`: (rows, cols) changed in place; `buffer`: rows top to bottom - 1, `width` values
    each; `starts`: (rows,) first column of the job in each row; `ends`: (rows,) column after the
    last; `width`: columns of the buffer; `top`: first row that the box can reach; `bottom`: row
    after the last.
    """
    for r in range(starts.size):
        row = image[r, starts[r] : ends[r]]
        if top <= r < bottom:
            at = (r - top) * width
            for c in range(row.size):
                row[c] = buffer[at + c] * share
        else:
            for c in range(row.size):
                row[c] = ZERO


@kernel
def take(image, buffer, starts, ends, width, top, bottom):
    """Copy the job's columns of an image, rows top to bottom - 1, into its buffer;
    arguments as those of `put`."""
    for r in range(top, bottom):
        row = image[r, starts[r] : ends[r]]
        at = (r - top) * width
        for c in range(row.size):
            buffer[at + c] = row[c]


@inline
def work_on(
    box,
    g,
    lines,
    first,
    last,
    shadow,
    image,
    starts,
    ends,
    collected,
    rays,
    work,
    buffer,
    side,
    transposed,
):
    """Do one job: fill the columns of an image between two lines; transposed, add them to
    the voxels.

    Pixels beyond the shadow's rows get zero, or are not read.

    Args:
        box: voxels; transposed, changed in place.
        g: (12,) source, first pixel minus source, u, v [voxels].
        lines: (m, 2) column of each line in row 0, and its slope.
        first: number of the first line.
        last: number of the last line.
        shadow: (4,) rows and columns that the box can reach.
        image: (rows, cols); changed in place unless transposed.
        starts: (rows,) room.
        ends: (rows,) room.
        collected: room for collected rays.
        rays: room for sorted rays.
        work: room for the walk.
        buffer: room for the job's pixels.
        side: rays along each side of a pixel of the image, whose lines and shadow are those of
            a panel that many times as fine; more than one only of a job of whole columns, and
            not transposed.
        transposed: see above.
    """
    rows, cols = image.shape[0] * side, image.shape[1] * side
    # The job's pixels lie between two slanted lines: each row has a start and an end of its
    # own, and the buffer holds the rows one behind the other, all `width` long.
    width = columns_of(lines, first, last, cols, starts, ends)
    if side > 1:
        for r in range(rows):
            starts[r], ends[r] = starts[r] // side, ends[r] // side
        width = width // side
    top, bottom = shadow[0] // side, (shadow[1] + side - 1) // side
    if transposed:
        take(image, buffer, starts, ends, width, top, bottom)
    else:
        for i in range((bottom - top) * width):
            buffer[i] = ZERO
    for line in range(first, last):
        grid = oriented(box, g, lines, line, rows)
        n = collect(collected, grid, g, lines, line, starts, width, shadow, side)
        if n > 0:
            carry_fan(box, g, grid, collected, rays, work, n, buffer, transposed)
    if not transposed:
        share = np.float32(1.0 / (side * side))
        put(
            image,
            buffer,
            starts[: image.shape[0]],
            ends[: image.shape[0]],
            width,
            top,
            bottom,
            share,
        )


def _entry_points(key: int):  # type: ignore[no-untyped-def]
    """Make the entry points `project_fans` and `spread_fans`, compiled at their first
    call.

    Args:
        key: hash of the sources that they inline; it is part of their machine code, so
            that other sources are compiled anew.
    """

    @parallel
    def project_fans(box, fans, shadows, workers, side, out):
        """Fill out with line integrals, but for views without a job.

        Rows and columns that the box cannot reach get zero.

        Args:
            box: voxels.
            fans: of the plan, see `FanPlan.fans`.
            shadows: (n, 4) rows and columns of each view that the box can reach.
            workers: number of threads.
            side: as of `work_on`.
            out: (n, rows, cols).
        """
        _ = key
        views, lines, jobs, room, widest = fans
        rows = out.shape[1] * side
        counter = np.zeros(1, np.int64)
        # Each worker keeps its memory and takes the next job when it is free: jobs differ in
        # cost.
        for _ in prange(workers):
            collected = make_collected(room)
            rays = make_rays(room)
            work = make_work(max(box.nx, box.ny), box.nz)
            starts = np.empty(rows, np.int64)
            ends = np.empty(rows, np.int64)
            buffer = np.empty(rows * widest, np.float32)
            job = fetch_next(counter)
            while job < len(jobs):
                view, first, last = jobs[job]
                work_on(
                    box,
                    views[view],
                    lines,
                    first,
                    last,
                    shadows[view],
                    out[view],
                    starts,
                    ends,
                    collected,
                    rays,
                    work,
                    buffer,
                    side,
                    False,
                )
                job = fetch_next(counter)

    @parallel
    def spread_fans(box, fans, turns, units, slices, shadows, marks, workers, values):
        """Apply the transpose of `project_fans`: add values (n, rows, cols) to the
        voxels.

        No two workers write the same voxel at a time: turns (k, 2) are taken one after
        the other, each a range of units that have no voxel column in common; units (m,
        2): ranges of jobs; slices (s, 2): ranges of z; shadows (s, n, 4) of each; marks
        (s, 2 nx ny): see `siddon_kernels.open_column`.

        All turns are one parallel loop: a worker that is free takes the next item, a unit
        and a slice, and begins when every item of the turn before is done. Items are
        taken in order, so one that is waited for is being worked on.
        """
        _ = key
        views, lines, jobs, room, widest = fans
        rows = values.shape[1]
        counter = np.zeros(1, np.int64)
        done = np.zeros(len(turns), np.int64)
        for _ in prange(workers):
            collected = make_collected(room)
            rays = make_rays(room)
            work = make_work(max(box.nx, box.ny), box.nz)
            starts = np.empty(rows, np.int64)
            ends = np.empty(rows, np.int64)
            buffer = np.empty(rows * widest, np.float32)
            g = np.empty(12)
            turn = first_item = before = 0
            item = fetch_next(counter)
            while turn < len(turns):
                count = (turns[turn, 1] - turns[turn, 0]) * len(slices)
                if item >= first_item + count:
                    first_item = first_item + count
                    before = count
                    turn = turn + 1
                    continue
                # Units of one turn have no voxel column in common, but do with those of the
                # turn before.
                if turn > 0:
                    wait_until(done, turn - 1, before)
                at = item - first_item
                part = at % len(slices)
                unit = turns[turn, 0] + at // len(slices)
                low, high = slices[part]
                # The slice as a box of its own: its first voxel is z = 0 of the piece.
                piece = Box(
                    box.flat,
                    marks[part],
                    box.base + low,
                    box.hop_x,
                    box.hop_y,
                    box.nx,
                    box.ny,
                    high - low,
                    box.size_x,
                    box.size_y,
                    box.size_z,
                )
                for job in range(units[unit, 0], units[unit, 1]):
                    view, first, last = jobs[job]
                    for i in range(12):
                        g[i] = views[view, i]
                    g[2] -= low  # the source, seen from the piece
                    work_on(
                        piece,
                        g,
                        lines,
                        first,
                        last,
                        shadows[part, view],
                        values[view],
                        starts,
                        ends,
                        collected,
                        rays,
                        work,
                        buffer,
                        1,
                        True,
                    )
                count_one(done, turn)
                item = fetch_next(counter)

    return project_fans, spread_fans


@parallel
def open_rest(box, slices, marks):
    """Set to zero the voxel columns that no ray has opened: they may hold old values.

    Args:
        box: voxels, changed in place.
        slices: (s, 2) ranges of z.
        marks: (s, 2 nx ny): see `siddon_kernels.open_column`.
    """
    for ix in prange(box.nx):
        for part in range(len(slices)):
            low, high = slices[part]
            for iy in range(box.ny):
                first = box.base + ix * box.hop_x + iy * box.hop_y + low
                open_column(
                    box.flat, marks[part], 2 * (iy * box.nx + ix), first, high - low
                )


project_fans, spread_fans = _entry_points(SOURCES)
