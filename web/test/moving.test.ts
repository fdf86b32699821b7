import assert from "node:assert/strict";
import { test } from "node:test";
import { decode, frameAt } from "../src/decode";
import { ballAt, turned } from "../src/geometry";
import type { Ball } from "../src/model";

const ball: Ball = { center: [9, 9], around: -1, radius: 9, out: false, owners: [0], names: ["goal"] };

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
  const packed = (...values: number[]) => Buffer.from(new Float32Array(values).buffer).toString("base64");
  const data = {
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
  const run = decode(data);
  const frame = frameAt(run, 0.5);
  assert.deepEqual([...frame.where], [1, 2]);
  assert.deepEqual([...(frame.headings ?? [])], [0.5]);
  assert.equal(frame.moment, 0.5);
  assert.equal(frameAt(decode({ ...data, bodies: null }), 0.5).headings, null);
});
