// The replay's document, and the live page's frames.

import { between, turned } from "./geometry";
import { FEW, type Frame, type Scene } from "./model";

export interface Recording extends Scene {
  clock: string;
  verdict: string;
  bounds: [number | null, number | null] | null;
  since: number | null;
  samples: number;
  steps: Float32Array;
  x: Float32Array;
  heading: Float32Array | null;
  margin: Float32Array;
  agentMargin: Float32Array;
  /** Whether the constraints could all hold, from when to when. */
  verdicts: [number, number, string][];
  bound: Float32Array | null;
  spread: number[];
}

function bytes(text: string): ArrayBuffer {
  const raw = atob(text);
  const out = new Uint8Array(raw.length);
  for (let i = 0; i < raw.length; i += 1) out[i] = raw.charCodeAt(i);
  return out.buffer;
}

// biome-ignore lint/suspicious/noExplicitAny: a document of schema consat.replay/1
export function decode(data: any): Recording {
  const floats = (text: string) => new Float32Array(bytes(text));
  const steps = floats(data.steps);
  return {
    ...data,
    x: floats(data.x),
    steps,
    margin: floats(data.margin),
    agentMargin: floats(data.agent_margin),
    links: new Int32Array(bytes(data.links)),
    heading: data.bodies?.heading ? floats(data.bodies.heading) : null,
    bound: data.bound === null ? null : floats(data.bound),
    count: data.ids.length,
    samples: steps.length,
    few: data.ids.length <= FEW,
    space: data.dimension === 3,
    silent: [],
    cut: [],
    hues: data.ids.map((_: string, i: number) => i),
  };
}

/** Where everybody is at a moment: a sample, or between two. */
export function frameAt(run: Recording, moment: number): Frame {
  const size = run.count * run.dimension;
  const at = Math.min(Math.max(moment, 0), run.samples - 1);
  const a = Math.floor(at);
  const b = Math.min(a + 1, run.samples - 1);
  const share = at - a;
  const sample = (s: number) => run.x.subarray(s * size, (s + 1) * size);
  const headings = (s: number) => run.heading!.subarray(s * run.count, (s + 1) * run.count);
  return {
    where: share === 0 ? sample(a) : between(sample(a), sample(b), share),
    margins: run.agentMargin.subarray(a * run.count, (a + 1) * run.count),
    headings: run.heading && turned(headings(a), headings(b), share),
    margin: run.margin[a],
    step: run.steps[a],
    phase: share,
    sample: a,
    moment: at,
    past: { length: run.samples, at: sample, name: "" },
  };
}

export interface LiveFrame {
  scene: number;
  round: number;
  margin: number;
  dimension: number;
  where: Float32Array;
  margins: Float32Array;
  headings: Float32Array | null;
}

const HEADER = 16;

/** A binary frame; null if it is none. */
export function unpack(data: ArrayBuffer): LiveFrame | null {
  if (data.byteLength < HEADER) return null;
  const view = new DataView(data);
  const dimension = view.getUint8(1);
  const turned = view.getUint16(2, true) & 1;
  const count = (data.byteLength - HEADER) / 4 / (dimension + 1 + turned);
  if (view.getUint8(0) !== 1 || dimension < 1 || dimension > 3 || !Number.isInteger(count)) return null;
  const floats = (from: number, size: number) => new Float32Array(data, HEADER + 4 * from, size);
  return {
    scene: view.getUint32(12, true),
    round: view.getUint32(4, true),
    margin: view.getFloat32(8, true),
    dimension,
    where: floats(0, count * dimension),
    margins: floats(count * dimension, count),
    headings: turned ? floats(count * (dimension + 1), count) : null,
  };
}
