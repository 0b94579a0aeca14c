// Axes of the small plots: ticks at round values with their numbers, and the unit.
const FONT_PX = 10;
const TICK_PX = 4;
// Wished distance of two ticks, in CSS pixels.
const APART_PX = 70;

// Round steps, about as many as wished, that cover a range.
export function ticks(low: number, high: number, wished: number): number[] {
  const span = high - low;
  if (!(span > 0) || !Number.isFinite(span)) return [];
  const rough = span / Math.max(1, wished);
  const power = 10 ** Math.floor(Math.log10(rough));
  const step = power * ([1, 2, 5, 10].find((factor) => factor * power >= rough * (1 - 1e-9)) ?? 10);
  const first = Math.ceil(low / step - 1e-9);
  const last = Math.floor(high / step + 1e-9);
  const places = Math.max(0, -Math.floor(Math.log10(step) + 1e-9));
  const tick = (k: number) => Number(((first + k) * step).toFixed(places));
  return Array.from({ length: last - first + 1 }, (_, k) => tick(k));
}
function pen(canvas: HTMLCanvasElement): CanvasRenderingContext2D | null {
  const context = canvas.getContext("2d");
  if (!context) return null;
  const style = getComputedStyle(canvas);
  const unit = devicePixelRatio;
  context.globalAlpha = 1;
  context.font = `${FONT_PX * unit}px system-ui, sans-serif`;
  context.fillStyle = style.getPropertyValue("--text");
  context.strokeStyle = style.getPropertyValue("--soft");
  context.lineWidth = 3 * unit;
  context.lineJoin = "round";
  return context;
}
function written(context: CanvasRenderingContext2D, text: string, x: number, y: number): void {
  context.strokeText(text, x, y);
  context.fillText(text, x, y);
}
// Along the lower side of a plot; numbers that lie over its ends are left out.
export function below(canvas: HTMLCanvasElement, low: number, high: number, unit: string): void {
  const context = pen(canvas);
  if (!context) return;
  const { width, height } = canvas;
  const scale = devicePixelRatio;
  context.textBaseline = "bottom";
  context.textAlign = "center";
  for (const value of ticks(low, high, width / scale / APART_PX)) {
    const x = (width * (value - low)) / (high - low);
    context.fillRect(x, height - TICK_PX * scale, scale, TICK_PX * scale);
    const half = context.measureText(String(value)).width / 2;
    const fits = x > half && x < width - half - 60 * scale;
    if (fits) written(context, String(value), x, height - TICK_PX * scale);
  }
  context.textAlign = "right";
  written(context, unit, width - 3 * scale, height - TICK_PX * scale);
}
// Along the left side: the least and the greatest value of the plot, with their unit.
export function beside(canvas: HTMLCanvasElement, low: number, high: number, unit: string): void {
  const context = pen(canvas);
  if (!context || !Number.isFinite(low + high)) return;
  const scale = devicePixelRatio;
  context.textAlign = "left";
  context.textBaseline = "top";
  written(context, `${Number(high.toPrecision(3))} ${unit}`, 3 * scale, 2 * scale);
  context.textBaseline = "bottom";
  written(context, String(Number(low.toPrecision(3))), 3 * scale, canvas.height - 14 * scale);
}
