import assert from "node:assert/strict";
import { test } from "node:test";
import { decode, frameAt } from "../src/decode";
import { ballAt, extent, turned, wallAt } from "../src/geometry";
import type { Ball, Wall } from "../src/model";

const ball: Ball = { center: [9, 9], around: -1, radius: 9, out: false, owners: [0], names: ["goal"] };

const packed = (...values: number[]) => Buffer.from(new Float32Array(values).buffer).toString("base64");
const RECORD = {
  ids: ["a"],
  dimension: 2,
  links: "",
  bound: null,
  x: packed(0, 0, 2, 4),
  steps: packed(0, 10),
  margin: packed(-1, 1),
  agent_margin: packed(-1, 1),
  bodies: { radius: [0.2], offset: [0.1], heading: packed(0, 1) },
};

test("a ball that moves is where its track says, and evenly between", () => {
  const track = {
    at: [0, 4, 6],
    center: [
      [0, 0],
      [8, 4],
      [8, 0],
    ],
    radius: [1, 3, 3],
  };
  const moving = { ...ball, track };
  const at = (moment: number) => {
    const { center, radius } = ballAt(moving, moment);
    return [...center, radius];
  };
  assert.deepEqual(at(0), [0, 0, 1]);
  assert.deepEqual(at(1), [2, 1, 1.5]);
  assert.deepEqual(at(4), [8, 4, 3]);
  assert.deepEqual(at(5), [8, 2, 3]);
  assert.deepEqual(at(60), [8, 0, 3]);
  assert.equal(ballAt(ball, 3), ball);
});

test("robots turn the shorter way round", () => {
  const between = turned(new Float32Array([3, 0]), new Float32Array([-3, 1]), 0.5);
  assert.ok(Math.abs(between[0] - Math.PI) < 1e-5);
  assert.equal(between[1], 0.5);
});

test("a recorded run tells which way robots look", () => {
  const run = decode(RECORD);
  const frame = frameAt(run, 0.5);
  assert.deepEqual([...frame.where], [1, 2]);
  assert.deepEqual([...(frame.headings ?? [])], [0.5]);
  assert.equal(frame.moment, 0.5);
  assert.equal(frameAt(decode({ ...RECORD, bodies: null }), 0.5).headings, null);
});

test("a half-space that moves is where its track says; out of view it has no corners", () => {
  const wall: Wall = { corners: [], normal: [1, 0], offset: 0, owners: [0], names: ["wall"], place: 0 };
  const ends = (x: number) => [
    [x, -1],
    [x, 1],
  ];
  const normal = [
    [1, 0],
    [1, 0],
    [1, 0],
  ];
  const moving = { ...wall, track: { at: [0, 2, 4], corners: [ends(0), ends(4), []], normal } };
  assert.deepEqual(wallAt(moving, 1).corners, ends(2));
  assert.deepEqual(wallAt(moving, 3).corners, ends(4));
  assert.deepEqual(wallAt(moving, 4).corners, []);
  assert.equal(wallAt(wall, 3), wall);
});

test("between two samples, step and margin are those of the first", () => {
  const frame = frameAt(decode(RECORD), 0.9);
  assert.deepEqual([frame.step, frame.margin, frame.sample], [0, -1, 0]);
  assert.deepEqual([...frame.margins], [-1]);
});

test("the box of a scene holds agents and regions as they are, but none that is far away", () => {
  const scene = {
    ...decode(RECORD),
    count: 2,
    balls: [
      { ...ball, center: [6, 0], radius: 1 },
      { ...ball, center: [500, 0], radius: 1 },
      { ...ball, center: [0, 0], radius: 2, around: 1 },
    ],
    walls: [],
    obstacles: [],
    low: [-1, -1],
    high: [1, 1],
  };
  const { low, high } = extent(scene, [0, 0, 4, 0]);
  assert.deepEqual(
    low.map((value) => Math.round(10 * value)),
    [-6, -32],
  );
  assert.deepEqual(
    high.map((value) => Math.round(10 * value)),
    [76, 32],
  );
});
