// The connection to the session: orders and their answers, over whatever carries messages.

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

/** What carries messages. It tells when it opens and closes, and `send` whether the text is on its way. */
export type Carrier = (ends: { open(on: boolean): void; data(data: string | ArrayBuffer): void }) => {
  send(text: string): boolean;
};

/** A web socket. When it breaks it is opened again, later and later up to some seconds. */
export function overSocket(location: { protocol: string; host: string; search: string }): Carrier {
  const address = `${location.protocol === "https:" ? "wss" : "ws"}://${location.host}/socket${location.search}`;
  return (ends) => {
    let socket: WebSocket | null = null;
    let wait = FIRST;
    function open(): void {
      socket = new WebSocket(address);
      socket.binaryType = "arraybuffer";
      socket.onopen = () => {
        wait = FIRST;
        ends.open(true);
      };
      socket.onmessage = (event) => ends.data(event.data);
      socket.onclose = () => {
        socket = null;
        ends.open(false);
        setTimeout(open, wait);
        wait = Math.min(LONGEST, 1.6 * wait);
      };
    }
    open();
    return {
      send(text) {
        if (socket?.readyState !== WebSocket.OPEN) return false;
        socket.send(text);
        return true;
      },
    };
  };
}

/** The port that a notebook's widget hands to the page that it frames; see widget.main.ts. */
export function overPort(page: Window): Carrier {
  return (ends) => {
    let port: MessagePort | null = null;
    page.addEventListener("message", (event) => {
      if (event.source !== page.parent || !event.ports.length) return;
      [port] = event.ports;
      port.onmessage = ({ data }) => ends.data(data);
      ends.open(true);
    });
    return {
      send(text) {
        port?.postMessage(text);
        return port !== null;
      },
    };
  };
}

export function connect(carrier: Carrier, listener: Listener) {
  let number = 0;
  const waiting = new Map<number, (answer: Answer) => void>();
  const line = carrier({
    open(on) {
      if (!on) {
        for (const [id, tell] of waiting) tell({ type: "answer", id, ok: false, words: "the connection broke" });
        waiting.clear();
      }
      listener.open(on);
    },
    data(data) {
      if (data instanceof ArrayBuffer) {
        listener.frame(data);
        return;
      }
      const message = JSON.parse(data);
      if (message.type === "answer" && waiting.has(message.id)) {
        waiting.get(message.id)!(message);
        waiting.delete(message.id);
      }
      listener.message(message);
    },
  });
  return {
    /** Whether an order waits for its answer. */
    busy: () => waiting.size > 0,
    /** Send an order; the promise gives its answer. */
    send(order: Record<string, unknown>): Promise<Answer> {
      number += 1;
      const id = number;
      return new Promise((resolve) => {
        if (line.send(JSON.stringify({ ...order, id }))) waiting.set(id, resolve);
        else resolve({ type: "answer", id, ok: false, words: "there is no connection" });
      });
    },
  };
}
