// The view in a notebook, an anywidget: the live page in a frame of its own, so that neither sees the other's styles and keys.
// Messages go from the kernel's comm to the frame's port and back. They are confirmed, since a comm keeps all that it is given; with the
// next order, or some at a time, since each request makes a notebook show that its kernel is busy.

const PATIENCE = 100;

interface Told {
  view: string;
  /** Null stands for the next of the buffers. */
  texts: (string | null)[];
}

interface Model {
  get(name: "page"): string;
  get(name: "height"): number;
  send(content: Record<string, unknown>): void;
  on(event: "msg:custom", hear: (told: Told, buffers: DataView[]) => void): void;
  off(event: "msg:custom", hear: (told: Told, buffers: DataView[]) => void): void;
}

function render({ model, el }: { model: Model; el: HTMLElement }): () => void {
  const view = `${Date.now()}-${Math.random()}`;
  let near: MessagePort | null = null;
  let taken = 0;
  let later = 0;
  const send = (content: Record<string, unknown>): void => {
    clearTimeout(later);
    later = 0;
    model.send({ view, taken, ...content });
    taken = 0;
  };
  const frame = document.createElement("iframe");
  frame.title = "consat: the team, live";
  frame.allow = "clipboard-write";
  frame.style.cssText = `width: 100%; height: ${model.get("height")}px; border: 0; display: block`;
  frame.srcdoc = model.get("page");
  const hear = (told: Told, buffers: DataView[]): void => {
    if (told.view !== view) return;
    let k = 0;
    for (const text of told.texts) {
      if (text !== null) near?.postMessage(text);
      else {
        const { buffer, byteOffset, byteLength } = buffers[k];
        near?.postMessage(buffer.slice(byteOffset, byteOffset + byteLength));
        k += 1;
      }
    }
    taken += 1;
    later ||= window.setTimeout(send, PATIENCE, {});
  };
  model.on("msg:custom", hear);
  // Again, where the notebook moves the cell: a frame that is moved begins anew.
  frame.addEventListener("load", () => {
    near?.close();
    const { port1, port2 } = new MessageChannel();
    near = port1;
    near.onmessage = ({ data }) => send({ order: data });
    frame.contentWindow?.postMessage("consat", "*", [port2]);
    taken = 0;
    send({ opened: true });
  });
  el.append(frame);
  return () => {
    model.off("msg:custom", hear);
    send({ closed: true });
    near?.close();
  };
}

export default { render };
