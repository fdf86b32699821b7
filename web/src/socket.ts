// The connection to the session. When it breaks it is taken up again, later and later up to some seconds.

const FIRST = 300;
const LONGEST = 4000;

export interface Answer {
  type: "answer";
  id: number | null;
  ok: boolean;
  words: string;
  text?: string;
}

// biome-ignore lint/suspicious/noExplicitAny: messages of the server are read field by field
export type Message = any;

export interface Listener {
  open(on: boolean): void;
  frame(data: ArrayBuffer): void;
  message(message: Message): void;
}

export function socketAddress(location: { protocol: string; host: string; search: string }): string {
  return `${location.protocol === "https:" ? "wss" : "ws"}://${location.host}/socket${location.search}`;
}

export function connect(address: string, listener: Listener) {
  let socket: WebSocket | null = null;
  let wait = FIRST;
  let number = 0;
  const waiting = new Map<number, (answer: Answer) => void>();

  function open(): void {
    socket = new WebSocket(address);
    socket.binaryType = "arraybuffer";
    socket.onopen = () => {
      wait = FIRST;
      listener.open(true);
    };
    socket.onmessage = (event) => {
      if (event.data instanceof ArrayBuffer) {
        listener.frame(event.data);
        return;
      }
      const message = JSON.parse(event.data);
      if (message.type === "answer" && waiting.has(message.id)) {
        waiting.get(message.id)!(message);
        waiting.delete(message.id);
      }
      listener.message(message);
    };
    socket.onclose = () => {
      socket = null;
      for (const [id, tell] of waiting) tell({ type: "answer", id, ok: false, words: "the connection broke" });
      waiting.clear();
      listener.open(false);
      setTimeout(open, wait);
      wait = Math.min(LONGEST, 1.6 * wait);
    };
  }

  open();
  return {
    /** Send an order; the promise gives its answer. */
    send(order: Record<string, unknown>): Promise<Answer> {
      number += 1;
      const id = number;
      return new Promise((resolve) => {
        if (socket?.readyState !== WebSocket.OPEN) {
          resolve({ type: "answer", id, ok: false, words: "there is no connection" });
          return;
        }
        waiting.set(id, resolve);
        socket.send(JSON.stringify({ ...order, id }));
      });
    },
  };
}
