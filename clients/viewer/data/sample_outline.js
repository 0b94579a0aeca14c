const HALF_PX = 0.5;
// What the picture lacks, for people; nothing where the sample is inside.
export function outline(sample, g, camera, sampleHeight_mm) {
    const size = sample.size_mm;
    const axis = g.axis_column_px;
    if (!size || axis === null || !Number.isFinite(axis))
        return [];
    const o = sample.offset;
    const upright = !o.rx && !o.ry;
    const half = upright ? 0.5 * Math.hypot(size[0], size[1]) : 0.5 * Math.hypot(...size);
    const radius = half + Math.hypot(o.x, o.y);
    if (radius >= g.SOD_mm)
        return ["the sample reaches the source"];
    const reach = (radius * g.SDD_mm) / Math.sqrt(g.SOD_mm ** 2 - radius ** 2) / camera.pixel_mm;
    const across = [axis - reach, axis + reach];
    const height = upright ? size[2] : 2 * half;
    const nearest = g.SDD_mm / (g.SOD_mm - radius) / camera.pixel_mm;
    const raised = ((o.z + sampleHeight_mm) * g.magnification) / camera.pixel_mm;
    const middle = g.piercing_point_px[1] - raised;
    const along = [middle - (height / 2) * nearest, middle + (height / 2) * nearest];
    const [rows, cols] = camera.shape;
    if (outside(across, cols) || outside(along, rows))
        return ["Sample is outside the image"];
    const cut = [];
    if (beyond(across, cols))
        cut.push("truncated sideways over a full turn");
    if (beyond(along, rows))
        cut.push("truncated at top or bottom");
    return cut.length ? [`Sample ${cut.join(", ")}`] : [];
}
const outside = ([from, to], count) => to < -HALF_PX || from > count - HALF_PX;
const beyond = ([from, to], count) => from < -HALF_PX || to > count - HALF_PX;
