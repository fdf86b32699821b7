// What the hosts have in common: hands on the picture, the list of agents, colours, and what is shown.

import type { Chart } from "./chart";
import { type Point, shadeOf } from "./geometry";
import { type Scene, say } from "./model";
import { type parts, preferDark } from "./page";
import { THEMES } from "./theme";
import type { Shown, View } from "./view";

type Part = ReturnType<typeof parts>;

/** What becomes of gestures. */
export interface Hands {
  /** A press: whether it takes hold of something; else the view is moved. */
  press(at: Point, event: PointerEvent): boolean;
  /** What is held is moved: whether it has gone far enough to be no click. */
  pull(at: Point): boolean;
  /** What was held is let go, as it is where there are two fingers. */
  drop(): void;
  click(at: Point): void;
  /** A mouse moves without a press; null as it leaves. */
  hover(at: Point | null, event: PointerEvent): void;
}

/** One finger or a mouse drags what it has hold of, or the view, which it turns in space; two fingers or a wheel zoom. */
export function watchHands(stage: HTMLElement, view: View, space: () => boolean, redraw: () => void, hands: Hands): void {
  const pointers = new Map<number, Point>();
  let holds = false;
  let moved = false;
  let apart = 0;
  const gap = () => {
    const [a, b] = [...pointers.values()];
    return Math.hypot(a[0] - b[0], a[1] - b[1]);
  };
  const local = (event: PointerEvent): Point => {
    const box = stage.getBoundingClientRect();
    return [event.clientX - box.left, event.clientY - box.top];
  };
  const drop = () => {
    holds = false;
    hands.drop();
    redraw();
  };

  stage.addEventListener("pointerdown", (event) => {
    const at = local(event);
    pointers.set(event.pointerId, at);
    stage.setPointerCapture(event.pointerId);
    moved = pointers.size > 1;
    if (pointers.size === 2) {
      apart = gap();
      drop();
    } else if (pointers.size === 1) holds = hands.press(at, event);
    redraw();
  });
  stage.addEventListener("pointermove", (event) => {
    const at = local(event);
    const from = pointers.get(event.pointerId);
    if (!from) {
      hands.hover(at, event);
      return;
    }
    if (pointers.size === 2) {
      pointers.set(event.pointerId, at);
      moved = true;
      const wide = gap();
      if (apart > 0) view.zoom(wide / apart, ...at);
      apart = wide;
    } else if (holds) moved = hands.pull(at) || moved;
    else {
      const [dx, dy] = [at[0] - from[0], at[1] - from[1]];
      if (!moved && Math.hypot(dx, dy) <= 3) return;
      moved = true;
      if (space()) view.orbit(dx, dy);
      else view.pan(dx, dy);
      pointers.set(event.pointerId, at);
    }
    redraw();
  });
  const release = (event: PointerEvent) => {
    if (!pointers.delete(event.pointerId)) return;
    if (!pointers.size) drop();
    if (!moved && event.type === "pointerup") hands.click(local(event));
  };
  stage.addEventListener("pointerup", release);
  stage.addEventListener("pointercancel", release);
  stage.addEventListener("pointerleave", (event) => hands.hover(null, event));
  stage.addEventListener(
    "wheel",
    (event) => {
      event.preventDefault();
      view.zoom(Math.exp(-event.deltaY * 0.0015), event.offsetX, event.offsetY);
      redraw();
    },
    { passive: false },
  );
}

/** A line of text beside the pointer; nothing where there is no text. */
export function tellAt(tip: HTMLElement, stage: HTMLElement, text: string, [x, y]: Point): void {
  tip.hidden = !text;
  tip.textContent = text;
  tip.style.left = `${Math.min(x + 14, stage.clientWidth - 230)}px`;
  tip.style.top = `${Math.min(y + 14, stage.clientHeight - 60)}px`;
}

/** Where an agent is, and its margin, in words. */
export function agentInWords(scene: Scene, i: number, where: Float32Array, margin: number): string {
  const nothing = 1e-6 * Math.max(...scene.high.map((high, axis) => high - scene.low[axis]));
  const own = [...where.subarray(i * scene.dimension, (i + 1) * scene.dimension)];
  const at = own.map((value) => say(Math.abs(value) < nothing ? 0 : value));
  return `${scene.ids[i]} at (${at.join(", ")})${scene.unit ? ` ${scene.unit}` : ""}, margin ${say(margin)}`;
}

/** Buttons and boxes that every host has. Gives whether colours are dark. */
export function bindControls(part: Part, view: View, chart: Chart, redraw: () => void, fit = view.fit): () => boolean {
  let dark = preferDark();
  const paint = () => {
    const name = dark ? "dark" : "light";
    document.documentElement.dataset.theme = name;
    view.theme(name);
    chart.theme(name);
    part("theme").setAttribute("aria-label", dark ? "Use light colours" : "Use dark colours");
    redraw();
  };
  part("theme").addEventListener("click", () => {
    dark = !dark;
    paint();
  });
  part("fit").addEventListener("click", () => {
    fit();
    redraw();
  });
  for (const name of ["trails", "links", "regions", "names"] as const satisfies (keyof Shown)[]) {
    const box = part<HTMLInputElement>(name);
    box.checked = view.show[name];
    box.addEventListener("change", () => {
      view.show[name] = box.checked;
      redraw();
    });
  }
  const resize = () => {
    view.resize();
    chart.resize();
    redraw();
  };
  resize();
  paint();
  new ResizeObserver(resize).observe(part("stage"));
  return () => dark;
}

/** An agent of the list, or one that was killed. */
export type Listed = { k: number; binds: boolean } | { silent: string };

/** The list of agents. */
export function createRows(rows: HTMLElement, dark: () => boolean, act: (who: Listed) => void) {
  let listed: Listed[] = [];

  function row(): HTMLElement {
    const made = document.createElement("button");
    made.type = "button";
    made.append(...["i", "b", "em", "span"].map((tag) => document.createElement(tag)));
    made.addEventListener("click", () => act(listed[[...rows.children].indexOf(made)]));
    return made;
  }

  return (scene: Scene, margins: Float32Array, chosen: Shown["chosen"], next: Listed[]): void => {
    listed = next;
    while (rows.children.length < listed.length) rows.append(row());
    while (rows.children.length > listed.length) rows.lastElementChild!.remove();
    const { agents } = THEMES[dark() ? "dark" : "light"];
    listed.forEach((who, at) => {
      const made = rows.children[at] as HTMLElement;
      const [dot, name, tag, told] = [...made.children] as HTMLElement[];
      tag.className = "tag";
      tag.textContent = "binds";
      if ("silent" in who) {
        made.className = "silent";
        delete made.dataset.agent;
        made.setAttribute("aria-pressed", "false");
        dot.style.background = "transparent";
        name.textContent = who.silent;
        tag.hidden = true;
        told.textContent = "killed: revive";
        told.className = "";
        return;
      }
      const margin = margins[who.k];
      made.className = "";
      made.dataset.agent = String(who.k);
      made.setAttribute("aria-pressed", String(chosen?.kind === "agent" && chosen.k === who.k));
      dot.style.background = scene.few ? agents[(scene.hues[who.k] ?? who.k) % agents.length] : shadeOf(scene.scale, margin);
      name.textContent = scene.ids[who.k];
      tag.hidden = !who.binds;
      told.textContent = Number.isFinite(margin) ? `${margin > 0 ? "✓" : "✗"} ${say(margin)}` : "no constraints";
      told.className = margin > 0 || !Number.isFinite(margin) ? "" : "bad";
    });
  };
}
