import assert from "node:assert/strict";
import { test } from "node:test";
import { unpack } from "../src/decode";
import { between, type Disc, gripOf, hitTest, type Point, placeLabels, scaleOf, shadeOf, type Targets, tightest } from "../src/geometry";
import { createPast } from "../src/past";

const disc = (x: number, y: number, r: number, more: Partial<Disc> = {}): Disc => ({
  x,
  y,
  r,
  moves: true,
  inside: true,
  rim: true,
  first: false,
  ...more,
});
const targets = (more: Partial<Targets>): Targets => ({ agents: [], discs: [], walls: [], links: [], ...more });

test("agents lie above middles, middles above rims, rims above links, and insides below all", () => {
  const all = targets({
    agents: [[0, 0]],
    discs: [disc(50, 0, 40)],
    links: [
      [
        [0, 0],
        [200, 0],
      ],
    ],
  });
  assert.deepEqual(hitTest(all, 3, 3, 12), { kind: "agent", k: 0 });
  assert.deepEqual(hitTest(all, 50, 5, 12), { kind: "grip", k: 0 });
  assert.deepEqual(hitTest(all, 91, 0, 12), { kind: "rim", k: 0 });
  assert.deepEqual(hitTest(all, 150, 3, 12), { kind: "link", k: 0 });
  assert.deepEqual(hitTest(all, 50, 25, 12), { kind: "grip", k: 0 });
  assert.equal(hitTest(all, 50, 90, 12), null);
});

test("the smallest of nested discs is taken by its inside", () => {
  const nested = targets({ discs: [disc(0, 0, 100), disc(40, 0, 30)] });
  assert.deepEqual(hitTest(nested, 40, 15, 8), { kind: "grip", k: 1 });
  assert.deepEqual(hitTest(nested, -60, 0, 8), { kind: "grip", k: 0 });
});

test("in a crowd a goal comes before the agent on it", () => {
  const crowd = targets({ agents: [[0, 0]], discs: [disc(0, 0, 8, { first: true })] });
  assert.deepEqual(hitTest(crowd, 1, 1, 12), { kind: "grip", k: 0 });
});

test("a disc whose middle an agent covers has a grip elsewhere", () => {
  const covered = targets({ agents: [[0, 0]], discs: [disc(0, 0, 60)] });
  const at = gripOf(covered, 0, 12);
  assert.ok(at && Math.hypot(...at) > 12);
  assert.deepEqual(hitTest(covered, ...at, 12), { kind: "grip", k: 0 });
  assert.equal(gripOf(targets({ agents: [[0, 0]], discs: [disc(0, 0, 5)] }), 0, 12), null);
});

test("names of agents that stand close do not overlap", () => {
  const points: Point[] = [
    [100, 100],
    [112, 100],
    [100, 112],
    [112, 112],
  ];
  const offsets = placeLabels(points, [30, 30, 30, 30], [400, 400]);
  const boxes = points.map(([x, y], i) => [x + offsets[i][0], y + offsets[i][1] - 12, x + offsets[i][0] + 30, y + offsets[i][1] + 3]);
  for (let i = 0; i < 4; i += 1) {
    for (let j = 0; j < i; j += 1) {
      const [a, b] = [boxes[i], boxes[j]];
      assert.ok(!(a[0] < b[2] && b[0] < a[2] && a[1] < b[3] && b[1] < a[3]), `${i} and ${j}`);
    }
  }
});

test("the scale has zero among its edges, and reds only below", () => {
  const scale = scaleOf([-3, -2, -1, 1, 2, 3, Number.POSITIVE_INFINITY]);
  assert.ok(scale.edges.includes(0));
  assert.equal(scale.shades.length, scale.edges.length + 1);
  assert.deepEqual(
    scale.edges,
    [...scale.edges].sort((a, b) => a - b),
  );
  assert.notEqual(shadeOf(scale, -0.5), shadeOf(scale, 0.5));
  assert.equal(shadeOf(scale, Number.NaN), "#b8bec6");
  for (const margins of [[], [1], [-1], [0, 0, 0]]) assert.equal(scaleOf(margins).shades.length, scaleOf(margins).edges.length + 1);
});

test("frames of the server are read, and nothing else", () => {
  const raw = new ArrayBuffer(16 + 4 * 3 * 2);
  const data = new DataView(raw);
  data.setUint8(0, 1);
  data.setUint8(1, 2);
  data.setUint32(4, 7, true);
  data.setFloat32(8, -1, true);
  data.setUint32(12, 3, true);
  [1, 2, 3, 4, 0.5, -0.5].forEach((value, k) => {
    data.setFloat32(16 + 4 * k, value, true);
  });
  const frame = unpack(raw);
  assert.ok(frame);
  assert.deepEqual([frame.round, frame.margin, frame.scene, [...frame.where], [...frame.margins]], [7, -1, 3, [1, 2, 3, 4], [0.5, -0.5]]);
  assert.equal(unpack(raw.slice(0, 20)), null);
  assert.equal(unpack(new ArrayBuffer(3)), null);
});

test("an hour of frames is bounded", () => {
  const past = createPast();
  for (let k = 0; k < 216_000; k += 1) past.add(k, 0, new Float32Array(20));
  assert.ok(past.length <= 1320);
  assert.equal(past.rounds.at(-1), 215_999);
});

test("who was not there was nowhere", () => {
  const past = createPast();
  past.add(0, 0, new Float32Array([1, 2, 3, 4]));
  past.follow(["a", "b"], ["b", "c"], 2);
  assert.deepEqual([...past.at(0)], [3, 4, Number.NaN, Number.NaN]);
});

test("the tightest are those that a sort would put first", () => {
  const margins = Array.from({ length: 500 }, (_, i) => (i % 50 === 7 ? Number.POSITIVE_INFINITY : Math.sin(7 * i)));
  const sorted = [...margins.keys()].sort((a, b) => margins[a] - margins[b]);
  assert.deepEqual(tightest(margins, 12), sorted.slice(0, 12));
  assert.deepEqual(tightest([Number.NaN, 2, 1], 12), [2, 1, 0]);
});

test("between", () => {
  assert.deepEqual([...between(new Float32Array([0, 2]), new Float32Array([1, 4]), 0.5)], [0.5, 3]);
});
