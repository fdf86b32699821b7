// Frame → picture, on a canvas. The view knows nothing of recordings or sockets.

import { ballAt, gripOf, type Hit, hitTest, type Point, placeLabels, shadeOf, type Targets, wallAt } from "./geometry";
import type { Ball, Frame, Obstacle, Outline, Scene, Wall } from "./model";
import { THEMES, type Theme, type ThemeName } from "./theme";

const MOST_SEGMENTS = 30000;
/** Of more agents no paths are drawn. */
const MOST_TRAILS = 3000;
/** Regions of a crowd can be taken by their inside up to this size, px; larger ones would leave no ground to pan by. */
const LARGEST_GRIP = 70;

/** Of a box the corners of each side; corner k is high on the axes whose bit of k, the first axis' first, is set. */
const SIDES = [
  [0, 1, 3, 2],
  [4, 5, 7, 6],
  [0, 1, 5, 4],
  [2, 3, 7, 6],
  [0, 2, 6, 4],
  [1, 3, 7, 5],
];

export type Chosen = { kind: "agent"; k: number } | { kind: "link"; k: number } | null;

export interface Held {
  kind: "grip" | "rim" | "wall";
  k: number;
}

export interface Shown {
  trails: boolean;
  links: boolean;
  regions: boolean;
  names: boolean;
  chosen: Chosen;
  /** What is held, or would be if the button were pressed. */
  held: Held | null;
  /** Whether regions can be taken hold of. */
  handles: boolean;
  /** Whether messages travel along links. */
  messages: boolean;
}

/** A picture of what stands still, which is copied much faster than it is drawn. */
interface Layer {
  pen: CanvasRenderingContext2D;
  /** Of what it is a picture. */
  key: string;
}

export function createView(canvas: HTMLCanvasElement, first: Scene) {
  const screen = canvas.getContext("2d", { alpha: false })!;
  /** What is being drawn on: the screen, or a layer. */
  let pen = screen;
  const ground: Layer = { pen: document.createElement("canvas").getContext("2d", { alpha: false })!, key: "" };
  const trails: Layer = { pen: document.createElement("canvas").getContext("2d")!, key: "" };
  let version = 0;
  let scene = first;
  let d = scene.dimension;
  let theme: Theme = THEMES.light;
  let width = 1;
  let height = 1;
  let ratio = 1;
  let scale = 1;
  const center = [0, 0, 0];
  let yaw = -0.9;
  let pitch = 0.45;
  let last: Frame | null = null;
  let fitted = false;
  let hatches = new Map<string, CanvasPattern>();
  let dots = new Map<string, HTMLCanvasElement>();
  const places: Point[] = [];
  const show: Shown = {
    trails: true,
    links: true,
    regions: true,
    names: true,
    chosen: null,
    held: null,
    handles: false,
    messages: false,
  };

  // ---- camera

  function fit(): void {
    const { low, high } = scene;
    for (let k = 0; k < 3; k += 1) center[k] = k < d ? (low[k] + high[k]) / 2 : 0;
    if (scene.space) {
      let reach = 0;
      for (let k = 0; k < 3; k += 1) reach += ((high[k] - low[k]) / 2) ** 2;
      scale = Math.min(width, height) / (2.1 * Math.sqrt(reach));
    } else scale = 0.94 * Math.min(width / (high[0] - low[0]), height / ((d > 1 ? high[1] - low[1] : high[0] - low[0]) || 1));
    fitted = true;
  }

  function resize(): void {
    const before = [width, height];
    ratio = Math.max(1, window.devicePixelRatio || 1);
    width = Math.max(1, canvas.clientWidth);
    height = Math.max(1, canvas.clientHeight);
    for (const each of [canvas, ground.pen.canvas, trails.pen.canvas]) {
      each.width = Math.round(width * ratio);
      each.height = Math.round(height * ratio);
    }
    hatches = new Map();
    dots = new Map();
    version += 1;
    if (!fitted || before[0] !== width || before[1] !== height) fit();
    if (last) draw(last);
  }

  function project(x: number, y: number, z: number): Point {
    const u = x - center[0];
    const v = y - center[1];
    const w = z - center[2];
    if (!scene.space) return [width / 2 + scale * u, height / 2 - scale * v];
    const right = Math.cos(yaw) * u - Math.sin(yaw) * v;
    const deep = Math.sin(yaw) * u + Math.cos(yaw) * v;
    return [width / 2 + scale * right, height / 2 - scale * (Math.cos(pitch) * w + Math.sin(pitch) * deep)];
  }

  /** How far from the viewer, in space. */
  function depth([x, y, z]: number[]): number {
    const deep = Math.sin(yaw) * (x - center[0]) + Math.cos(yaw) * (y - center[1]);
    return Math.cos(pitch) * deep - Math.sin(pitch) * (z - center[2]);
  }

  /** A point moved by so many pixels, in the plane of the picture. */
  function moved(point: number[], dx: number, dy: number): number[] {
    const [u, v] = [dx / scale, -dy / scale];
    const step = scene.space
      ? [
          u * Math.cos(yaw) + v * Math.sin(pitch) * Math.sin(yaw),
          -u * Math.sin(yaw) + v * Math.sin(pitch) * Math.cos(yaw),
          v * Math.cos(pitch),
        ]
      : [u, v, 0];
    return point.map((value, k) => value + (step[k] ?? 0));
  }

  const spot = (values: ArrayLike<number>, i: number): Point =>
    project(values[i * d], d > 1 ? values[i * d + 1] : 0, d > 2 ? values[i * d + 2] : 0);
  const agentColour = (i: number) => theme.agents[(scene.hues[i] ?? i) % theme.agents.length];
  const ownerColour = (owners: number[], out: boolean) =>
    scene.few && owners.length === 1 ? agentColour(owners[0]) : out ? theme.bar : scene.few ? theme.axis : theme.area;
  const isHeld = (kind: Held["kind"], k: number) => show.held?.k === k && (show.held.kind === "wall") === (kind === "wall");
  const isChosen = (owners: number[]) => show.chosen?.kind === "agent" && owners.includes(show.chosen.k);

  function hatch(colour: string): CanvasPattern {
    let pattern = hatches.get(colour);
    if (!pattern) {
      const tile = document.createElement("canvas");
      const side = Math.round(8 * ratio);
      tile.width = tile.height = side;
      const ink = tile.getContext("2d")!;
      ink.strokeStyle = colour;
      ink.lineWidth = 1.1 * ratio;
      ink.globalAlpha = 0.85;
      ink.beginPath();
      for (const s of [-side, 0, side]) {
        ink.moveTo(s - 1, side + 1);
        ink.lineTo(s + side + 1, -1);
      }
      ink.stroke();
      pattern = pen.createPattern(tile, "repeat")!;
      pattern.setTransform(new DOMMatrix().scale(1 / ratio));
      hatches.set(colour, pattern);
    }
    return pattern;
  }

  /** A disc as a picture, which is copied much faster than it is drawn. */
  function dot(colour: string, radius: number): HTMLCanvasElement {
    const key = `${colour}${radius}`;
    let found = dots.get(key);
    if (!found) {
      found = document.createElement("canvas");
      found.width = found.height = Math.ceil(2 * (radius + 1) * ratio);
      const ink = found.getContext("2d")!;
      ink.scale(ratio, ratio);
      ink.fillStyle = colour;
      ink.strokeStyle = scene.few ? theme.paper : theme.ink;
      ink.lineWidth = scene.few ? 1.5 : 0.6;
      ink.beginPath();
      ink.arc(radius + 1, radius + 1, radius, 0, 2 * Math.PI);
      ink.fill();
      ink.globalAlpha = scene.few ? 1 : 0.6;
      ink.stroke();
      dots.set(key, found);
    }
    return found;
  }

  // ---- regions

  function ballCenter(where: Float32Array, ball: Ball): number[] {
    const at = [0, 0, 0];
    for (let k = 0; k < d; k += 1) at[k] = ball.center[k] + (ball.around < 0 ? 0 : where[ball.around * d + k]);
    return at;
  }

  function drawBall(frame: Frame, told: Ball, loud: boolean, held: boolean): void {
    if (!scene.few && told.around >= 0 && !loud) return;
    const ball = ballAt(told, frame.moment);
    const at = ballCenter(frame.where, ball);
    const [px, py] = project(at[0], at[1], at[2]);
    const r = scale * ball.radius;
    const colour = ownerColour(ball.owners, ball.out);
    pen.beginPath();
    pen.arc(px, py, r, 0, 2 * Math.PI);
    pen.fillStyle = colour;
    pen.globalAlpha = (ball.out ? 0.16 : ball.around >= 0 ? 0.03 : 0.1) + (held ? 0.1 : 0);
    pen.fill();
    if (ball.out) {
      pen.globalAlpha = 0.9;
      pen.fillStyle = hatch(colour);
      pen.fill();
    }
    pen.globalAlpha = ball.around >= 0 && !loud ? 0.5 : 0.95;
    pen.strokeStyle = colour;
    pen.lineWidth = held ? 3 : loud ? 2.2 : ball.around >= 0 ? 1 : 1.5;
    pen.setLineDash(ball.around >= 0 ? [5, 4] : []);
    pen.stroke();
    pen.setLineDash([]);
    if (scene.space) {
      pen.globalAlpha *= 0.5;
      pen.lineWidth = 0.8;
      for (const ring of [
        [0, 1],
        [0, 2],
        [1, 2],
      ]) {
        pen.beginPath();
        for (let k = 0; k <= 40; k += 1) {
          const p = [...at];
          p[ring[0]] += ball.radius * Math.cos((k * Math.PI) / 20);
          p[ring[1]] += ball.radius * Math.sin((k * Math.PI) / 20);
          const [qx, qy] = project(p[0], p[1], p[2]);
          if (k) pen.lineTo(qx, qy);
          else pen.moveTo(qx, qy);
        }
        pen.stroke();
      }
    }
    if (show.handles && ball.around < 0 && (scene.few || loud)) {
      // The grip: a small cross at the middle.
      pen.globalAlpha = held ? 1 : 0.75;
      pen.lineWidth = held ? 2.5 : 1.5;
      pen.beginPath();
      pen.moveTo(px - 6, py);
      pen.lineTo(px + 6, py);
      pen.moveTo(px, py - 6);
      pen.lineTo(px, py + 6);
      pen.stroke();
    }
    pen.globalAlpha = 1;
  }

  /** The goals of a crowd: overlaps are tinted once, and of very many no edges are drawn. */
  function drawUnion(frame: Frame): void {
    const goals = scene.balls
      .filter((ball, k) => !ball.out && ball.around < 0 && !isHeld("grip", k) && !isChosen(ball.owners))
      .map((ball) => ballAt(ball, frame.moment));
    pen.beginPath();
    for (const ball of goals) {
      const at = ballCenter(frame.where, ball);
      const [px, py] = project(at[0], at[1], at[2]);
      const r = scale * ball.radius;
      if (px + r < 0 || py + r < 0 || px - r > width || py - r > height) continue;
      pen.moveTo(px + r, py);
      pen.arc(px, py, r, 0, 2 * Math.PI);
    }
    pen.fillStyle = pen.strokeStyle = theme.area;
    pen.lineWidth = 0.8;
    pen.globalAlpha = 0.12;
    pen.fill();
    if (goals.length <= 200) {
      pen.globalAlpha = 0.6;
      pen.stroke();
    }
    pen.globalAlpha = 1;
  }

  function path(points: ArrayLike<number>[]): void {
    points.forEach((corner, k) => {
      const [px, py] = project(corner[0], corner[1] ?? 0, corner[2] ?? 0);
      if (k) pen.lineTo(px, py);
      else pen.moveTo(px, py);
    });
  }

  function drawWall(frame: Frame, told: Wall, held: boolean): void {
    const wall = wallAt(told, frame.moment);
    const colour = ownerColour(wall.owners, false);
    pen.strokeStyle = pen.fillStyle = colour;
    pen.lineWidth = held ? 3.5 : isChosen(wall.owners) ? 2.4 : 1.4;
    pen.beginPath();
    path(wall.corners);
    if (scene.space) {
      pen.closePath();
      pen.globalAlpha = 0.06;
      pen.fill();
    }
    pen.globalAlpha = 0.9;
    pen.stroke();
    if (!scene.space && wall.corners.length === 2) {
      const [a, b] = wall.corners.map((corner) => project(corner[0], corner[1], 0));
      const far = Math.hypot(b[0] - a[0], b[1] - a[1]);
      pen.lineWidth = 1;
      pen.beginPath();
      for (let s = 6; s < far; s += 14) {
        const px = a[0] + ((b[0] - a[0]) * s) / far;
        const py = a[1] + ((b[1] - a[1]) * s) / far;
        if (px < -20 || py < -20 || px > width + 20 || py > height + 20) continue;
        pen.moveTo(px, py);
        pen.lineTo(px + 6 * wall.normal[0], py - 6 * wall.normal[1]);
      }
      pen.stroke();
    }
    pen.globalAlpha = 1;
  }

  function drawOutline(frame: Frame, outline: Outline): void {
    let k = 0;
    while (k < outline.at.length - 1 && outline.at[k + 1] <= frame.sample) k += 1;
    pen.strokeStyle = ownerColour(outline.owners, false);
    pen.lineWidth = isChosen(outline.owners) ? 2.2 : 1.3;
    pen.globalAlpha = 0.85;
    pen.beginPath();
    for (const line of outline.lines[k]) {
      for (let j = 0; j < line.length; j += 2) {
        const [px, py] = project(line[j], line[j + 1], 0);
        if (j) pen.lineTo(px, py);
        else pen.moveTo(px, py);
      }
    }
    pen.stroke();
    pen.globalAlpha = 1;
  }

  function drawSide(corners: number[][]): void {
    pen.beginPath();
    path(corners);
    pen.closePath();
    pen.fill();
    pen.stroke();
  }

  /** What stands in the way: solid, as nothing else is. Of a box in space the farthest side is drawn first. */
  function drawObstacle(obstacle: Obstacle): void {
    pen.fillStyle = theme.solid;
    pen.strokeStyle = theme.edge;
    pen.lineWidth = 1.2;
    const { center: middle, radius, low, high, vertices } = obstacle;
    if (middle && radius) {
      const [px, py] = project(middle[0], middle[1], middle[2] ?? 0);
      pen.beginPath();
      pen.arc(px, py, scale * radius, 0, 2 * Math.PI);
      pen.fill();
      pen.stroke();
    } else if (vertices) drawSide(vertices);
    else if (low && high) {
      const ends = [low, high];
      const corner = (k: number) => [ends[(k >> 2) & 1][0], ends[(k >> 1) & 1][1], ends[k & 1][2] ?? 0];
      const far = (side: number[]) => side.reduce((sum, k) => sum + depth(corner(k)), 0);
      const sides = scene.space ? [...SIDES].sort((one, other) => far(other) - far(one)) : [[0, 4, 6, 2]];
      for (const side of sides) drawSide(side.map(corner));
    }
  }

  // ---- ground

  function drawGrid(): void {
    const { low, high } = scene;
    const lo = scene.space ? low : [center[0] - width / 2 / scale, center[1] - height / 2 / scale];
    const hi = scene.space ? high : [center[0] + width / 2 / scale, center[1] + height / 2 / scale];
    const raw = 80 / scale;
    const power = 10 ** Math.floor(Math.log10(raw));
    const unit = ([1, 2, 5, 10].find((m) => m * power >= raw) ?? 10) * power;
    const floor = scene.space ? low[2] : 0;
    const labels: [string, number, number][] = [];
    pen.strokeStyle = theme.grid;
    pen.lineWidth = 1;
    pen.beginPath();
    for (let axis = 0; axis < Math.min(2, d); axis += 1) {
      for (let k = Math.ceil(lo[axis] / unit); k * unit <= hi[axis]; k += 1) {
        const value = k * unit;
        const a = axis ? project(lo[0], value, floor) : project(value, lo[1] || 0, floor);
        const b = axis ? project(hi[0], value, floor) : project(value, hi[1] || 0, floor);
        pen.moveTo(a[0], a[1]);
        pen.lineTo(b[0], b[1]);
        const text = String(Number(value.toPrecision(6))).replace("-", "−");
        if (!scene.space && (axis ? a[1] > 16 && a[1] < height - 22 : a[0] > 4))
          labels.push(axis ? [text, 4, a[1] - 3] : [text, a[0] + 3, height - 5]);
      }
    }
    pen.stroke();
    pen.fillStyle = theme.axis;
    pen.font = "11px system-ui, sans-serif";
    for (const [text, px, py] of labels) pen.fillText(text, px, py);
  }

  function drawAxes(): void {
    const { low, high } = scene;
    pen.fillStyle = pen.strokeStyle = theme.axis;
    pen.font = "12px system-ui, sans-serif";
    pen.lineWidth = 1;
    for (let axis = 0; axis < 3; axis += 1) {
      const end = [low[0], low[1], low[2]];
      end[axis] = high[axis];
      const a = project(low[0], low[1], low[2]);
      const b = project(end[0], end[1], end[2]);
      pen.beginPath();
      pen.moveTo(a[0], a[1]);
      pen.lineTo(b[0], b[1]);
      pen.stroke();
      const far = Math.hypot(b[0] - a[0], b[1] - a[1]) || 1;
      const unit = scene.unit ? ` ${scene.unit}` : "";
      pen.textAlign = "center";
      const text = `${"xyz"[axis]} = ${Number(end[axis].toPrecision(2))}${unit}`.replace("-", "−");
      pen.fillText(text, b[0] + (16 * (b[0] - a[0])) / far, b[1] + (16 * (b[1] - a[1])) / far);
      pen.textAlign = "left";
    }
  }

  // ---- what moves

  function drawTrails(frame: Frame, camera: string): void {
    const { past, sample } = frame;
    if (scene.count > MOST_TRAILS) return;
    const count = Math.min(sample + 1, past.length);
    const stride = Math.max(1, Math.ceil((count * scene.count) / MOST_SEGMENTS));
    const one = (i: number) => {
      let on = false;
      for (let s = 0; s < count; s += stride) {
        const x = past.at(s);
        if (!Number.isFinite(x[i * d])) {
          on = false;
          continue;
        }
        const [px, py] = spot(x, i);
        if (on) pen.lineTo(px, py);
        else pen.moveTo(px, py);
        on = true;
      }
      if (scene.few && on) pen.lineTo(places[i][0], places[i][1]);
    };
    if (scene.few) {
      pen.lineJoin = "round";
      pen.lineWidth = 1.8;
      pen.globalAlpha = 0.7;
      for (let i = 0; i < scene.count; i += 1) {
        pen.strokeStyle = agentColour(i);
        pen.beginPath();
        one(i);
        pen.stroke();
      }
      pen.globalAlpha = 1;
    } else if (count) {
      // Of a crowd anew with each round, not with each frame between two.
      copied(trails, [camera, count, past.name].join(), () => {
        pen.lineJoin = "round";
        pen.strokeStyle = theme.trail;
        pen.lineWidth = 1;
        pen.beginPath();
        for (let i = 0; i < scene.count; i += 1) one(i);
        pen.stroke();
      });
    }
  }

  function drawLinks(frame: Frame): void {
    const { links } = scene;
    pen.strokeStyle = theme.link;
    pen.lineWidth = scene.few ? 1.1 : 0.7;
    pen.globalAlpha = scene.few ? 0.75 : 0.55;
    if (scene.few) pen.setLineDash([2, 3]);
    pen.beginPath();
    for (let k = 0; k < links.length; k += 2) {
      const a = places[links[k]];
      const b = places[links[k + 1]];
      pen.moveTo(a[0], a[1]);
      pen.lineTo(b[0], b[1]);
    }
    pen.stroke();
    pen.setLineDash([]);
    pen.globalAlpha = 1;
    if (show.messages && links.length <= 120) {
      // A message each way in every round.
      const share = frame.phase;
      pen.fillStyle = theme.link;
      pen.beginPath();
      for (let k = 0; k < links.length; k += 1) {
        const a = places[links[k]];
        const b = places[links[k % 2 ? k - 1 : k + 1]];
        const [px, py] = [a[0] + (b[0] - a[0]) * share, a[1] + (b[1] - a[1]) * share];
        pen.moveTo(px + 2.2, py);
        pen.arc(px, py, 2.2, 0, 2 * Math.PI);
      }
      pen.fill();
    }
    if (show.chosen?.kind === "link" && 2 * show.chosen.k + 1 < links.length) {
      const [a, b] = [places[links[2 * show.chosen.k]], places[links[2 * show.chosen.k + 1]]];
      pen.strokeStyle = theme.ink;
      pen.lineWidth = 3;
      pen.beginPath();
      pen.moveTo(a[0], a[1]);
      pen.lineTo(b[0], b[1]);
      pen.stroke();
    }
  }

  function drawGone(): void {
    pen.strokeStyle = theme.bad;
    pen.lineWidth = 1.2;
    pen.setLineDash([1, 6]);
    pen.beginPath();
    for (const pair of scene.cut) path(pair);
    pen.stroke();
    pen.setLineDash([]);
    pen.strokeStyle = pen.fillStyle = theme.axis;
    pen.lineWidth = 2;
    pen.font = "12px system-ui, sans-serif";
    for (const each of scene.silent) {
      const [px, py] = project(each.at[0], each.at[1] ?? 0, each.at[2] ?? 0);
      pen.beginPath();
      pen.moveTo(px - 5, py - 5);
      pen.lineTo(px + 5, py + 5);
      pen.moveTo(px + 5, py - 5);
      pen.lineTo(px - 5, py + 5);
      pen.stroke();
      pen.fillText(each.id, px + 9, py + 4);
    }
  }

  function drawFeet(frame: Frame): void {
    pen.strokeStyle = theme.axis;
    pen.globalAlpha = 0.5;
    pen.setLineDash([1, 3]);
    pen.lineWidth = 1;
    pen.beginPath();
    for (let i = 0; i < scene.count; i += 1) {
      const foot = project(frame.where[i * d], frame.where[i * d + 1], scene.low[2]);
      pen.moveTo(places[i][0], places[i][1]);
      pen.lineTo(foot[0], foot[1]);
    }
    pen.stroke();
    pen.setLineDash([]);
    pen.globalAlpha = 1;
  }

  /** The body of a robot, in pixels: its middle, its radius, and which way it looks. */
  function bodyOf(frame: Frame, i: number): { middle: Point; r: number; ahead: Point } {
    const offset = scene.bodies?.offset[i] ?? 0;
    const angle = frame.headings?.[i] ?? 0;
    const ahead: Point = frame.headings ? [Math.cos(angle), Math.sin(angle)] : [0, 0];
    const [x, y, z] = [0, 1, 2].map((k) => (k < d ? frame.where[i * d + k] : 0));
    return { middle: project(x - offset * ahead[0], y - offset * ahead[1], z), r: scale * (scene.bodies?.radius[i] ?? 0), ahead };
  }

  /** The bodies of robots in their true size, each with a stroke to where it looks. */
  function drawBodies(frame: Frame): void {
    pen.strokeStyle = theme.edge;
    for (let i = 0; i < scene.count; i += 1) {
      const { middle, r, ahead } = bodyOf(frame, i);
      pen.fillStyle = scene.few ? agentColour(i) : shadeOf(scene.scale, frame.margins[i]);
      pen.globalAlpha = scene.few ? 0.6 : 0.95;
      pen.lineWidth = 1;
      pen.beginPath();
      pen.arc(middle[0], middle[1], r, 0, 2 * Math.PI);
      pen.fill();
      pen.globalAlpha = 1;
      pen.stroke();
      if (frame.headings && scene.bodies?.offset[i]) {
        pen.lineWidth = 1.6;
        pen.beginPath();
        pen.moveTo(middle[0], middle[1]);
        pen.lineTo(middle[0] + r * ahead[0], middle[1] - r * ahead[1]);
        pen.stroke();
      }
    }
  }

  const agentRadius = () =>
    scene.bodies ? 2.5 : scene.few ? 6.5 : scene.count < 60 ? 5 : scene.count < 300 ? 4 : scene.count < 3000 ? 3 : 2;

  function drawAgents(frame: Frame): void {
    const radius = agentRadius();
    if (scene.space && scene.count <= 1000) drawFeet(frame);
    if (scene.count > 3000) {
      // Squares, a colour at a time: the fastest that there is without WebGL.
      const groups = new Map<string, number[]>();
      for (let i = 0; i < scene.count; i += 1) {
        const colour = shadeOf(scene.scale, frame.margins[i]);
        const group = groups.get(colour);
        if (group) group.push(i);
        else groups.set(colour, [i]);
      }
      for (const [colour, members] of groups) {
        pen.fillStyle = colour;
        for (const i of members) pen.fillRect(Math.round(places[i][0]) - radius, Math.round(places[i][1]) - radius, 2 * radius, 2 * radius);
      }
    } else {
      for (let i = 0; i < scene.count; i += 1) {
        const picture = dot(scene.few ? agentColour(i) : shadeOf(scene.scale, frame.margins[i]), radius);
        const side = picture.width / ratio;
        pen.drawImage(picture, places[i][0] - side / 2, places[i][1] - side / 2, side, side);
      }
    }
    const ring = (i: number, gap: number) => {
      const body = scene.bodies ? bodyOf(frame, i) : { middle: places[i], r: 0 };
      const [[px, py], r] = [body.middle, Math.max(radius, body.r) + gap];
      pen.moveTo(px + r, py);
      pen.arc(px, py, r, 0, 2 * Math.PI);
    };
    if (scene.few) {
      // A violated agent also has a ring, for those who cannot tell the colours.
      pen.strokeStyle = theme.bad;
      pen.lineWidth = 1.8;
      pen.beginPath();
      for (let i = 0; i < scene.count; i += 1) {
        if (frame.margins[i] <= 0) {
          ring(i, 4);
        }
      }
      pen.stroke();
    }
    const chosen = show.chosen?.kind === "agent" && show.chosen.k < scene.count ? show.chosen.k : -1;
    if (chosen >= 0) {
      pen.strokeStyle = theme.ink;
      pen.lineWidth = 2;
      pen.beginPath();
      ring(chosen, 7);
      pen.stroke();
    }
    drawNames(frame, chosen);
  }

  function drawNames(frame: Frame, chosen: number): void {
    pen.font = "600 13px system-ui, sans-serif";
    pen.lineJoin = "round";
    const who = show.names && scene.few ? [...scene.ids.keys()] : chosen >= 0 ? [chosen] : [];
    if (!who.length) return;
    const texts = who.map((i) => (scene.ids[i].length > 16 ? `${scene.ids[i].slice(0, 15)}…` : scene.ids[i]));
    const bodies = scene.bodies && who.map((i) => bodyOf(frame, i));
    const at = bodies ? bodies.map(({ middle }) => middle) : who.map((i) => places[i]);
    const offsets = placeLabels(
      at,
      texts.map((text) => pen.measureText(text).width),
      [width, height],
      Math.max(7, ...(bodies ?? []).map(({ r }) => r + 4)),
    );
    texts.forEach((text, k) => {
      const [px, py] = [at[k][0] + offsets[k][0], at[k][1] + offsets[k][1]];
      pen.strokeStyle = theme.paper;
      pen.lineWidth = 4;
      pen.strokeText(text, px, py);
      pen.fillStyle = scene.few ? agentColour(who[k]) : theme.ink;
      pen.fillText(text, px, py);
    });
  }

  /** Draw what stands still on a layer, if it is not there yet, and copy it. */
  function copied(layer: Layer, key: string, paint: () => void): void {
    if (layer.key !== key) {
      layer.key = key;
      pen = layer.pen;
      pen.setTransform(ratio, 0, 0, ratio, 0, 0);
      pen.clearRect(0, 0, width, height);
      paint();
      pen = screen;
    }
    pen.drawImage(layer.pen.canvas, 0, 0, width, height);
  }

  function drawGround(): void {
    pen.fillStyle = theme.paper;
    pen.fillRect(0, 0, width, height);
    drawGrid();
    if (scene.space) drawAxes();
    scene.obstacles.forEach(drawObstacle);
  }

  /** Regions, but those that are held or chosen. */
  function drawRegions(frame: Frame): void {
    scene.walls.forEach((wall, k) => {
      if (!isHeld("wall", k)) drawWall(frame, wall, false);
    });
    if (!scene.few && !scene.space) drawUnion(frame);
    for (const out of [false, true]) {
      scene.balls.forEach((ball, k) => {
        const alone = ball.out || scene.few || scene.space;
        if (alone && ball.out === out && !isChosen(ball.owners) && !isHeld("grip", k)) drawBall(frame, ball, false, false);
      });
    }
  }

  function draw(frame: Frame): void {
    last = frame;
    places.length = scene.count;
    for (let i = 0; i < scene.count; i += 1) places[i] = spot(frame.where, i);
    screen.setTransform(ratio, 0, 0, ratio, 0, 0);
    const camera = [version, scale, ...center, yaw, pitch].join();
    if (scene.few) {
      drawGround();
      if (show.regions) drawRegions(frame);
    } else {
      // In a crowd regions stand still: those that move with a teammate are not drawn.
      const moment = [...scene.balls, ...scene.walls].some((shape) => shape.track) ? frame.moment : 0;
      const { held, chosen, regions } = show;
      copied(ground, [camera, moment, regions, held?.kind, held?.k, chosen?.kind, chosen?.k].join(), () => {
        drawGround();
        if (regions) drawRegions(frame);
      });
    }
    if (show.regions) for (const outline of scene.outlines) drawOutline(frame, outline);
    scene.walls.forEach((wall, k) => {
      if (isHeld("wall", k)) drawWall(frame, wall, true);
    });
    scene.balls.forEach((ball, k) => {
      if (isChosen(ball.owners) || isHeld("grip", k)) drawBall(frame, ball, !scene.few || isChosen(ball.owners), isHeld("grip", k));
    });
    if (show.trails) drawTrails(frame, camera);
    if (show.links) drawLinks(frame);
    drawGone();
    if (scene.bodies) drawBodies(frame);
    drawAgents(frame);
  }

  // ---- what lies where

  function targets(): Targets {
    const where = last?.where ?? new Float32Array(scene.count * d);
    const bare = { x: 0, y: 0, r: 0, moves: false, inside: false, rim: false, first: false };
    const links: [Point, Point][] = [];
    if (show.links && scene.count <= 300) {
      for (let k = 0; k < scene.links.length; k += 2) links.push([places[scene.links[k]], places[scene.links[k + 1]]]);
    }
    return {
      agents: places,
      discs: scene.balls.map((told) => {
        const ball = ballAt(told, last?.moment ?? 0);
        const loud = isChosen(ball.owners);
        if (!show.handles || !(show.regions || loud)) return bare;
        const at = ballCenter(where, ball);
        const [x, y] = project(at[0], at[1], at[2]);
        const r = scale * ball.radius;
        const moves = ball.around < 0 || (loud && ball.center.some((value) => value !== 0));
        return {
          x,
          y,
          r,
          moves,
          inside: moves && ball.around < 0 && (scene.few || loud || r <= LARGEST_GRIP),
          rim: scene.few || loud,
          first: moves && !scene.few && r < 20,
        };
      }),
      walls:
        show.handles && show.regions && !scene.space
          ? scene.walls.map((wall) => wall.corners.map((corner) => project(corner[0], corner[1] ?? 0, 0)) as [Point, Point])
          : [],
      links,
    };
  }

  return {
    draw,
    fit,
    resize,
    show,
    moved,
    get scale() {
      return scale;
    },
    set(next: Scene) {
      const fresh = scene.count === 0;
      scene = next;
      d = scene.dimension;
      dots = new Map();
      version += 1;
      if (fresh) fit();
    },
    /** Regions have changed. */
    reshape() {
      version += 1;
    },
    where: (i: number): Point | null => (last && i < scene.count ? spot(last.where, i) : null),
    hit: (px: number, py: number, reach: number): Hit | null => (last ? hitTest(targets(), px, py, reach) : null),
    grip: (k: number): Point => gripOf(targets(), k, 24) ?? gripOf(targets(), k, 12) ?? [targets().discs[k].x, targets().discs[k].y],
    middle: (ball: Ball): Point => {
      const at = ballCenter(last?.where ?? new Float32Array(scene.count * d), ballAt(ball, last?.moment ?? 0));
      return project(at[0], at[1], at[2]);
    },
    line: (wall: Wall): Point[] => wall.corners.map((corner) => project(corner[0], corner[1] ?? 0, corner[2] ?? 0)),
    ground: (px: number, py: number): number[] => moved([center[0], center[1], center[2]].slice(0, d), px - width / 2, py - height / 2),
    pan(dx: number, dy: number) {
      center[0] -= dx / scale;
      center[1] += dy / scale;
    },
    orbit(dx: number, dy: number) {
      yaw += dx * 0.008;
      pitch = Math.min(1.5, Math.max(-0.2, pitch + dy * 0.008));
    },
    zoom(factor: number, px = width / 2, py = height / 2) {
      const [u, v] = [(px - width / 2) / scale, (py - height / 2) / scale];
      scale *= factor;
      if (!scene.space) {
        center[0] += u - u / factor;
        center[1] -= v - v / factor;
      }
    },
    theme(name: ThemeName) {
      theme = THEMES[name];
      hatches = new Map();
      dots = new Map();
      version += 1;
    },
  };
}

export type View = ReturnType<typeof createView>;
