import assert from "node:assert/strict";
import { test } from "node:test";
import { type Carrier, connect, overPort, overSocket } from "../src/socket";

type Ends = Parameters<Carrier>[0];

function fake() {
  const sent: string[] = [];
  let told: Ends | null = null;
  let on = true;
  const heard: unknown[] = [];
  const line = connect(
    (ends) => {
      told = ends;
      return {
        send(text) {
          if (on) sent.push(text);
          return on;
        },
      };
    },
    { open: (is) => heard.push(is), frame: (data) => heard.push(data.byteLength), message: (message) => heard.push(message.type) },
  );
  return {
    line,
    sent,
    heard,
    ends: told as unknown as Ends,
    off: () => {
      on = false;
    },
  };
}

test("an order is numbered, and its answer is the promise's", async () => {
  const { line, sent, heard, ends } = fake();
  const answer = line.send({ do: "play" });
  assert.deepEqual(JSON.parse(sent[0]), { do: "play", id: 1 });
  ends.data(JSON.stringify({ type: "answer", id: 1, ok: true, words: "" }));
  ends.data(new ArrayBuffer(3));
  assert.equal((await answer).ok, true);
  assert.deepEqual(heard, ["answer", 3]);
});

test("orders whose connection breaks, or is not there, are answered in words", async () => {
  const { line, ends, off } = fake();
  const answer = line.send({ do: "play" });
  ends.open(false);
  assert.equal((await answer).words, "the connection broke");
  off();
  assert.equal((await line.send({ do: "play" })).words, "there is no connection");
});

test("a framed page takes the port of its parent, and of nobody else", async () => {
  const page = new EventTarget() as unknown as Window & EventTarget;
  const parent = {};
  Object.assign(page, { parent });
  const heard: unknown[] = [];
  let hear = (): void => {};
  const came = new Promise<void>((resolve) => {
    hear = resolve;
  });
  const line = overPort(page)({
    open: (on) => heard.push(on),
    data: (data) => {
      heard.push(data);
      hear();
    },
  });
  assert.equal(line.send("too early"), false);
  const { port1, port2 } = new MessageChannel();
  const from = (source: unknown, ports: MessagePort[]) => page.dispatchEvent(Object.assign(new Event("message"), { source, ports }));
  from({}, [port2]);
  assert.deepEqual(heard, []);
  from(parent, [port2]);
  port1.postMessage("scene");
  await came;
  assert.deepEqual(heard, [true, "scene"]);
  const answered = new Promise((resolve) => {
    port1.onmessage = ({ data }) => resolve(data);
  });
  assert.equal(line.send("order"), true);
  assert.equal(await answered, "order");
  port1.close();
});

test("the socket is where the page is, and is opened again when it breaks", async () => {
  const made: { url: string; onopen(): void; onclose(): void }[] = [];
  class Socket {
    static OPEN = 1;
    readyState = 0;
    constructor(readonly url: string) {
      made.push(this as never);
    }
  }
  Object.assign(globalThis, { WebSocket: Socket });
  const heard: boolean[] = [];
  const line = overSocket({ protocol: "https:", host: "a:1", search: "?token=x" })({ open: (on) => heard.push(on), data: () => {} });
  assert.equal(made[0].url, "wss://a:1/socket?token=x");
  assert.equal(line.send("x"), false);
  made[0].onopen();
  made[0].onclose();
  await new Promise((resolve) => setTimeout(resolve, 400));
  assert.equal(made.length, 2);
  assert.deepEqual(heard, [true, false]);
});
