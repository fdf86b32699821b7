// Pure functions of the view: what lies under a pointer, where labels go, which colours margins have.

import type { Ball, Scale, Scene, Wall } from "./model";

export type Point = [number, number];
type Box = [number, number, number, number];

export interface Disc {
  x: number;
  y: number;
  r: number;
  /** Whether it can be moved, by its middle or anywhere inside; and whether it can be resized. */
  moves: boolean;
  inside: boolean;
  rim: boolean;
  /** Whether it comes before the agents. */
  first: boolean;
}

export interface Targets {
  agents: ArrayLike<Point>;
  discs: Disc[];
  /** Segments, each with its own number. */
  walls: [Point, Point][];
  links: [Point, Point][];
}

export type Hit =
  | { kind: "agent"; k: number }
  | { kind: "grip"; k: number }
  | { kind: "rim"; k: number }
  | { kind: "wall"; k: number }
  | { kind: "link"; k: number };

export function distanceToSegment([px, py]: Point, [a, b]: [Point, Point]): number {
  const dx = b[0] - a[0];
  const dy = b[1] - a[1];
  const along = dx * dx + dy * dy;
  const t = along === 0 ? 0 : Math.min(1, Math.max(0, ((px - a[0]) * dx + (py - a[1]) * dy) / along));
  return Math.hypot(px - a[0] - t * dx, py - a[1] - t * dy);
}

/** What is under a pointer: agents first, then middles, rims, walls, links, and last the insides of discs, the smallest first. */
export function hitTest(targets: Targets, px: number, py: number, reach: number): Hit | null {
  const nearest = (count: number, far: (k: number) => number, within: number): number => {
    let best = -1;
    let least = within;
    for (let k = 0; k < count; k += 1) {
      const distance = far(k);
      if (distance < least) {
        least = distance;
        best = k;
      }
    }
    return best;
  };
  const { agents, discs, walls, links } = targets;
  const middle = (k: number) => (discs[k].moves ? Math.hypot(discs[k].x - px, discs[k].y - py) : Number.POSITIVE_INFINITY);
  // In a crowd agents sit on their goals: there the goal is what is taken hold of.
  const small = nearest(discs.length, (k) => (discs[k].first ? middle(k) : Number.POSITIVE_INFINITY), reach * 0.8);
  if (small >= 0) return { kind: "grip", k: small };
  const agent = nearest(agents.length, (k) => Math.hypot(agents[k][0] - px, agents[k][1] - py), reach);
  if (agent >= 0) return { kind: "agent", k: agent };
  const grip = nearest(discs.length, middle, reach);
  if (grip >= 0) return { kind: "grip", k: grip };
  const rim = nearest(
    discs.length,
    (k) => (discs[k].rim ? Math.abs(Math.hypot(discs[k].x - px, discs[k].y - py) - discs[k].r) : Number.POSITIVE_INFINITY),
    reach * 0.7,
  );
  if (rim >= 0) return { kind: "rim", k: rim };
  const wall = nearest(walls.length, (k) => distanceToSegment([px, py], walls[k]), reach * 0.7);
  if (wall >= 0) return { kind: "wall", k: wall };
  const link = nearest(links.length, (k) => distanceToSegment([px, py], links[k]), reach * 0.5);
  if (link >= 0) return { kind: "link", k: link };
  const inside = nearest(
    discs.length,
    (k) => (discs[k].inside && middle(k) < discs[k].r ? discs[k].r : Number.POSITIVE_INFINITY),
    Number.POSITIVE_INFINITY,
  );
  return inside >= 0 ? { kind: "grip", k: inside } : null;
}

/** Where a disc can be taken by its inside or its middle: the first of some places at which nothing else is in the way, or null. */
export function gripOf(targets: Targets, k: number, reach: number): Point | null {
  const disc = targets.discs[k];
  for (const share of [0, 0.45, 0.7, 0.25, 0.85]) {
    for (let turn = 0; turn < (share === 0 ? 1 : 12); turn += 1) {
      const angle = (Math.PI * (2 * turn + 1)) / 12;
      const at: Point = [disc.x + share * disc.r * Math.cos(angle), disc.y - share * disc.r * Math.sin(angle)];
      const hit = hitTest(targets, at[0], at[1], reach);
      if (hit?.kind === "grip" && hit.k === k) return at;
    }
  }
  return null;
}

const overlap = (a: Box, b: Box): boolean => a[0] < b[2] && b[0] < a[2] && a[1] < b[3] && b[1] < a[3];

/**
 * Where names stand: for each point the offset of its text's left end of the baseline, so that it meets the fewest others.
 * `widths` in px; texts are 12 px high. Points that shall have no name have width 0; all are
 * drawn with radius `size`.
 */
export function placeLabels(points: ArrayLike<Point>, widths: number[], [width, height]: Point, size = 7): Point[] {
  const taken: Box[] = Array.from(points, ([x, y]) => [x - size, y - size, x + size, y + size]);
  return Array.from(points, ([x, y], i) => {
    const wide = widths[i];
    if (wide === 0) return [0, 0];
    const off = 0.7 * size + 4;
    const spots: Point[] = [
      [off, -off],
      [-off - wide, -off],
      [off, off + 10],
      [-off - wide, off + 10],
      [-wide / 2, -size - 6],
      [-wide / 2, size + 16],
      [size + 7, 4],
      [-size - 7 - wide, 4],
      [size + 5, -size - 17],
      [size + 5, size + 25],
    ];
    const boxes = spots.map(([u, v]): Box => [x + u, y + v - 12, x + u + wide, y + v + 3]);
    const meets = boxes.map(
      (a) =>
        taken.filter((b, k) => k !== i && overlap(a, b)).length + (a[0] < 2 || a[1] < 2 || a[2] > width - 2 || a[3] > height - 2 ? 1.5 : 0),
    );
    const best = meets.indexOf(Math.min(...meets));
    taken.push(boxes[best]);
    return spots[best];
  });
}

const REDS = ["#a31a2c", "#c94741", "#e58368", "#f7b799"];
const BLUES = ["#a7d0e4", "#6bacd1", "#3783bb", "#1b5a9b"];

/** A scale whose steps hold as many agents each: reds for violated, blues for satisfied, which the colour-blind can tell apart. */
export function scaleOf(margins: ArrayLike<number>): Scale {
  const finite = Float32Array.from(margins).filter(Number.isFinite).sort();
  const bad = finite.filter((value) => value <= 0);
  const good = finite.filter((value) => value > 0);
  const quantile = (values: Float32Array, share: number) => values[Math.min(values.length - 1, Math.floor(share * values.length))];
  const edges: number[] = [];
  const shades: string[] = [];
  const inner = [0.25, 0.5, 0.75];
  const below = bad.length ? [...new Set(inner.map((share) => quantile(bad, share)))].filter((edge) => edge < 0) : [];
  const above = good.length ? [...new Set(inner.map((share) => quantile(good, share)))] : [];
  edges.push(...below, 0, ...above);
  shades.push(...REDS.slice(0, below.length + 1), ...BLUES.slice(BLUES.length - above.length - 1));
  return { edges, shades };
}

/** The places of the least margins, the least first; agents without constraints come last. */
export function tightest(margins: ArrayLike<number>, most: number): number[] {
  const found: number[] = [];
  const key = (i: number) => (Number.isFinite(margins[i]) ? margins[i] : Number.POSITIVE_INFINITY);
  for (let i = 0; i < margins.length; i += 1) {
    const mine = key(i);
    if (found.length === most && mine >= key(found[most - 1])) continue;
    let k = Math.min(found.length, most - 1);
    for (; k > 0 && key(found[k - 1]) > mine; k -= 1) found[k] = found[k - 1];
    found[k] = i;
  }
  return found;
}

export function shadeOf(scale: Scale, margin: number): string {
  if (!Number.isFinite(margin)) return "#b8bec6";
  let k = 0;
  while (k < scale.edges.length && margin > scale.edges[k]) k += 1;
  return scale.shades[k];
}

/** (1 - share) a + share b. */
export function between(a: Float32Array, b: Float32Array, share: number): Float32Array {
  if (share >= 1 || a.length !== b.length) return b;
  const out = new Float32Array(b.length);
  for (let k = 0; k < b.length; k += 1) out[k] = (1 - share) * a[k] + share * b[k];
  return out;
}

/** Angles between two, the shorter way round. */
export function turned(a: Float32Array, b: Float32Array, share: number): Float32Array {
  if (share >= 1 || a.length !== b.length) return b;
  return a.map((first, i) => first + share * Math.atan2(Math.sin(b[i] - first), Math.cos(b[i] - first)));
}

/** A ball as it is at a moment of a record. */
export function ballAt(ball: Ball, moment: number): Ball {
  if (!ball.track) return ball;
  const { center, radius } = ball.track;
  const { a, b, mix } = within(ball.track.at, moment);
  return { ...ball, center: center[a].map((value, k) => mix(value, center[b][k])), radius: mix(radius[a], radius[b]) };
}

/** A half-space as it is at a moment. A boundary that gets more or fewer corners on the way stays as it was until it has them. */
export function wallAt(wall: Wall, moment: number): Wall {
  if (!wall.track) return wall;
  const { corners, normal } = wall.track;
  const { a, b, mix } = within(wall.track.at, moment);
  const between = corners[a].length === corners[b].length;
  const mixed = (u: number[], v: number[]) => u.map((value, k) => mix(value, v[k]));
  return {
    ...wall,
    corners: between ? corners[a].map((corner, k) => mixed(corner, corners[b][k])) : corners[a],
    normal: mixed(normal[a], normal[b]),
  };
}

/** Between which of some samples a moment lies, and a mean of values at both. */
function within(at: number[], moment: number) {
  let a = 0;
  while (a < at.length - 1 && at[a + 1] <= moment) a += 1;
  const b = Math.min(a + 1, at.length - 1);
  const share = b > a ? Math.min(1, Math.max(0, (moment - at[a]) / (at[b] - at[a]))) : 0;
  return { a, b, mix: (u: number, v: number) => (1 - share) * u + share * v };
}

/** A region is left out of the view if it makes it so many times wider than the formation, and than the region itself. */
const FAR = 6;

/** The box that holds a scene as it is: agents, obstacles, and regions that are not far away. */
export function extent(scene: Scene, where: ArrayLike<number>): { low: number[]; high: number[] } {
  const d = scene.dimension;
  const axes = [...Array(d).keys()];
  const low = axes.map(() => Number.POSITIVE_INFINITY);
  const high = axes.map(() => Number.NEGATIVE_INFINITY);
  const side = (a: number[], b: number[]) => Math.max(...axes.map((k) => b[k] - a[k]), 0);
  const add = (from: number[], to: number[]) => {
    for (const k of axes) {
      low[k] = Math.min(low[k], from[k]);
      high[k] = Math.max(high[k], to[k]);
    }
  };
  for (let i = 0; i < scene.count; i += 1) {
    const at = axes.map((k) => where[i * d + k]);
    if (at.every(Number.isFinite)) add(at, at);
  }
  if (!Number.isFinite(low[0])) return { low: scene.low, high: scene.high };
  const team = side(low, high);
  const hold = (points: number[][]) => {
    if (!points.length) return;
    const from = axes.map((k) => Math.min(...points.map((point) => point[k] ?? 0)));
    const to = axes.map((k) => Math.max(...points.map((point) => point[k] ?? 0)));
    const whole = side(
      low.map((value, k) => Math.min(value, from[k])),
      high.map((value, k) => Math.max(value, to[k])),
    );
    if (whole <= FAR * Math.max(team, side(from, to))) add(from, to);
  };
  const round = (center: number[], radius: number) => hold([center.map((value) => value - radius), center.map((value) => value + radius)]);
  for (const ball of scene.balls)
    if (ball.around < 0) round(ball.center, ball.radius);
    else if (scene.few)
      round(
        ball.center.map((value, k) => value + where[ball.around * d + k]),
        ball.radius,
      );
  const span = side(scene.low, scene.high);
  for (const { corners } of scene.walls) if (corners.every((corner) => distance(corner, corners[0]) <= 3 * span)) hold(corners);
  for (const each of scene.obstacles)
    if (each.center) round(each.center, each.radius ?? 0);
    else hold(each.vertices ?? [each.low!, each.high!]);
  for (const { at } of scene.silent) hold([at]);
  const least = side(low, high) || 1;
  for (const k of axes) {
    const spare = Math.max(0, 0.75 * least - (high[k] - low[k])) / 2 + 0.08 * least;
    low[k] -= spare;
    high[k] += spare;
  }
  return { low, high };
}

const distance = (a: number[], b: number[]) => Math.hypot(...a.map((value, k) => value - b[k]));
