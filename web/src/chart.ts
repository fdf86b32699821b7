// The margin over time, on a scale that shows both its sign and its size.

import { say } from "./model";
import { THEMES, type Theme, VERDICTS } from "./theme";

export interface Series {
  steps: ArrayLike<number>;
  margin: ArrayLike<number>;
  count: number;
  clock: string;
  bounds: [number | null, number | null] | null;
  since: number | null;
  bound: ArrayLike<number> | null;
  /** From when to when the constraints could all hold, or not. */
  verdicts: [number, number, string][];
}

const LEFT = 46;

export function createChart(canvas: HTMLCanvasElement) {
  const pen = canvas.getContext("2d")!;
  let theme: Theme = THEMES.light;
  let width = 1;
  let height = 1;
  let ratio = 1;
  let first = 0;
  let final = 1;

  function draw(series: Series, now: { step: number; margin: number }): void {
    const { count } = series;
    let last = 1;
    let least = 0;
    let most = 0;
    for (let s = 0; s < count; s += 1) if (Number.isFinite(series.margin[s])) last = series.margin[s];
    const end = Math.abs(last) || 1;
    const bend = (v: number) => Math.asinh(v / (end / 2));
    const include = (v: number | null) => {
      if (v !== null && Number.isFinite(v)) {
        least = Math.min(least, bend(v));
        most = Math.max(most, bend(v));
      }
    };
    for (let s = 0; s < count; s += 1) include(series.margin[s]);
    for (const bound of series.bounds ?? []) include(bound);
    const top = most + 0.15;
    const bottom = least - 0.15;
    first = count ? series.steps[0] : 0;
    final = count ? series.steps[count - 1] : 1;
    const px = (step: number) => LEFT + ((width - LEFT - 10) * (step - first)) / (final - first || 1);
    const py = (v: number) => 8 + ((height - 28) * (top - bend(v))) / (top - bottom);
    const line = (ax: number, ay: number, bx: number, by: number) => {
      pen.beginPath();
      pen.moveTo(ax, ay);
      pen.lineTo(bx, by);
      pen.stroke();
    };
    const curve = (values: ArrayLike<number>, colour: string, dash: number[]) => {
      pen.strokeStyle = colour;
      pen.lineWidth = 1.8;
      pen.setLineDash(dash);
      pen.beginPath();
      let on = false;
      const stride = Math.max(1, Math.floor(count / 1500));
      for (let s = 0; s < count; s = s + stride < count || s === count - 1 ? s + stride : count - 1) {
        if (!Number.isFinite(values[s])) {
          on = false;
          continue;
        }
        const y = Math.min(Math.max(py(values[s]), 0), height);
        if (on) pen.lineTo(px(series.steps[s]), y);
        else pen.moveTo(px(series.steps[s]), y);
        on = true;
      }
      pen.stroke();
      pen.setLineDash([]);
    };

    pen.setTransform(ratio, 0, 0, ratio, 0, 0);
    pen.clearRect(0, 0, width, height);
    pen.font = "11px system-ui, sans-serif";
    pen.textAlign = "right";
    const [lower, upper] = series.bounds ?? [null, null];
    if (lower !== null && upper !== null) {
      pen.fillStyle = "#009E73";
      pen.globalAlpha = 0.3;
      const y = py(upper);
      pen.fillRect(LEFT, y - 1, width - LEFT - 10, Math.max(2, py(lower) - y));
      pen.globalAlpha = 1;
    }
    pen.lineWidth = 1;
    pen.fillStyle = theme.axis;
    const power = 10 ** Math.round(Math.log10(end));
    const drawn: number[] = [];
    for (const v of [0, ...[1, 0.1, 10, 100, 1000, 1e4, 1e5].flatMap((m) => [m * power, -m * power])]) {
      const y = py(v);
      if (y < 6 || y > height - 22 || drawn.some((other) => Math.abs(other - y) < 14)) continue;
      drawn.push(y);
      pen.strokeStyle = v === 0 ? theme.ink : theme.grid;
      line(LEFT, y, width - 10, y);
      pen.fillText(String(Number(v.toPrecision(1))).replace("-", "−"), LEFT - 4, y + 4);
    }
    for (const [from, to, verdict] of series.verdicts) {
      pen.fillStyle = VERDICTS[verdict];
      pen.fillRect(px(from), height - 20, Math.max(1, px(to) - px(from)), 4);
    }
    pen.fillStyle = theme.axis;
    pen.textAlign = "center";
    pen.fillText(series.clock === "time" ? "time [s]" : "round", width / 2, height - 4);
    pen.textAlign = "left";
    pen.fillText(say(first, 5), LEFT, height - 4);
    pen.textAlign = "right";
    pen.fillText(say(final, 5), width - 10, height - 4);
    if (series.since !== null) {
      pen.strokeStyle = "#CC79A7";
      pen.setLineDash([2, 3]);
      line(px(series.since), 4, px(series.since), height - 18);
      pen.setLineDash([]);
    }
    if (series.bound) curve(series.bound, "#D55E00", [2, 3]);
    curve(series.margin, theme.area, []);
    const x = px(now.step);
    pen.strokeStyle = theme.ink;
    pen.lineWidth = 1;
    line(x, 4, x, height - 18);
    if (Number.isFinite(now.margin)) {
      pen.fillStyle = theme.ink;
      pen.beginPath();
      pen.arc(x, py(now.margin), 3.5, 0, 2 * Math.PI);
      pen.fill();
    }
  }

  return {
    draw,
    resize() {
      ratio = Math.max(1, window.devicePixelRatio || 1);
      width = canvas.clientWidth;
      height = canvas.clientHeight;
      canvas.width = Math.round(width * ratio);
      canvas.height = Math.round(height * ratio);
    },
    theme(name: keyof typeof THEMES) {
      theme = THEMES[name];
    },
    stepAt: (x: number) => first + ((x - LEFT) / (width - LEFT - 10)) * (final - first),
  };
}
export type Chart = ReturnType<typeof createChart>;
