// What hosts and view share. Positions are flat arrays, N × d.

/** Where a ball is that moves by a schedule: told at some samples of a record, and it moves evenly between them. */
export interface Track {
  at: number[];
  center: number[][];
  radius: number[];
}

/** Where a half-space ends that moves by a schedule; without corners where it is out of view. */
export interface WallTrack {
  at: number[];
  corners: number[][][];
  normal: number[][];
}

export interface Ball {
  center: number[];
  /** Place of the agent that it moves with, or -1. */
  around: number;
  radius: number;
  /** Whether its owners must stay outside. */
  out: boolean;
  owners: number[];
  names: string[];
  track?: Track | null;
}

export interface Wall {
  corners: number[][];
  normal: number[];
  offset: number;
  owners: number[];
  names: string[];
  place: number;
  track?: WallTrack | null;
}

export interface Outline {
  at: number[];
  lines: number[][][];
  owners: number[];
}

export interface Obstacle {
  kind: "disc" | "box" | "polygon";
  center?: number[];
  radius?: number;
  low?: number[];
  high?: number[];
  vertices?: number[][];
}

/** Of each robot its radius, and how far the body's middle is behind its position, along its heading. */
export interface Bodies {
  radius: number[];
  offset: number[];
}

export interface Silent {
  id: string;
  at: number[];
}

/** shades[k] is the colour of margins from edges[k - 1] to edges[k]. */
export interface Scale {
  edges: number[];
  shades: string[];
}

export interface Scene {
  name: string;
  unit: string | null;
  dimension: number;
  ids: string[];
  count: number;
  few: boolean;
  space: boolean;
  links: Int32Array;
  balls: Ball[];
  walls: Wall[];
  outlines: Outline[];
  obstacles: Obstacle[];
  /** Null where agents are points. */
  bodies: Bodies | null;
  silent: Silent[];
  cut: [number[], number[]][];
  low: number[];
  high: number[];
  scale: Scale;
  /** Which colour each of a few agents has, so that it keeps it when others come and go. */
  hues: number[];
}

/** Where everybody was: at(k) has N × d numbers. */
export interface History {
  length: number;
  at(k: number): Float32Array;
  /** Tells one from another of the same scene. */
  name: string;
}

export interface Frame {
  where: Float32Array;
  margins: Float32Array;
  /** Which way robots look, rad. */
  headings: Float32Array | null;
  margin: number;
  /** Round, or time in s, of the margins. */
  step: number;
  /** How far the messages of the next round are on their way, 0 to 1. */
  phase: number;
  /** Entries of the history that have passed. */
  sample: number;
  /** The same, with how much of the next has passed. */
  moment: number;
  past: History;
}

/** Up to so many agents have colours of their own. */
export const FEW = 12;

export const say = (value: number | null | undefined, digits = 3): string =>
  value !== null && value !== undefined && Number.isFinite(value)
    ? (Math.abs(value) >= 1e4 ? value.toExponential(1) : String(Number(value.toPrecision(digits)))).replace("-", "−")
    : "none";
