// The live page: what the session tells is drawn, and what hands do becomes orders to it.

import { createChart } from "./chart";
import { agentInWords, bindControls, createRows, tellAt, watchHands } from "./controls";
import { unpack } from "./decode";
import { between, extent, type Hit, type Point, scaleOf, tightest, turned } from "./geometry";
import { type Ball, FEW, type Frame, type Scene, say } from "./model";
import { parts } from "./page";
import { createPanel } from "./panel";
import { createPast } from "./past";
import { type Answer, type Carrier, connect, type Message } from "./socket";
import { createView, type Held } from "./view";

const SPEEDS = [1, 2, 5, 10, 20, 50, 100, 200, 500];
/** Rounds whose paths are drawn. */
const TRAIL = 200;
const MOUSE = 12;
const TOUCH = 24;

export interface State {
  playing: boolean;
  speed: number;
  loss: number;
  protocol: string;
  protocols: string[];
  undo: number;
  busy: string | null;
  cut: [string, string][];
  silent: Record<string, number[]>;
}

interface Moment {
  where: Float32Array;
  margins: Float32Array;
  headings: Float32Array | null;
  round: number;
  margin: number;
  at: number;
}

/** What a gesture has hold of. */
interface Drag {
  held: Held | { kind: "agent"; k: number };
  id: string;
  gesture: number;
  from: Point;
  begun: boolean;
  /** What it was when it was taken hold of. */
  center: number[];
  radius: number;
  offset: number;
  order: Record<string, unknown> | null;
  waiting: boolean;
}

const EMPTY: Scene = {
  name: "",
  unit: null,
  dimension: 2,
  ids: [],
  count: 0,
  few: true,
  space: false,
  links: new Int32Array(),
  balls: [],
  walls: [],
  outlines: [],
  obstacles: [],
  bodies: null,
  silent: [],
  cut: [],
  low: [-1, -1],
  high: [1, 1],
  scale: { edges: [0], shades: ["#a31a2c", "#1b5a9b"] },
  hues: [],
};

export function createLive(root: HTMLElement, carrier: Carrier) {
  const part = parts(root);
  const stage = part<HTMLCanvasElement>("stage");
  const slider = part<HTMLInputElement>("slider");
  const tip = part("tip");
  const note = part("note");
  const view = createView(stage, EMPTY);
  const chart = createChart(part<HTMLCanvasElement>("chart"));
  const past = createPast();
  let scene = EMPTY;
  let number = 0;
  let constraints: [number, string][] = [];
  let state: State = { playing: true, speed: 20, loss: 0, protocol: "", protocols: [], undo: 0, busy: null, cut: [], silent: {} };
  let bounds: [number | null, number | null] | null = null;
  let verdict = "undecided";
  let reasons: string[] = [];
  /** The revision of the team that the session is known to have reached, and the one that the verdict is of. */
  let reached = 0;
  let assessed = -1;
  /** Whether the verdict may be of a team that has changed since, here or there. */
  const stale = () => assessed < reached || line.busy() || drag?.order != null;
  let connected = false;
  let before: Moment | null = null;
  let now: Moment | null = null;
  let looking = -1;
  let drag: Drag | null = null;
  let adding = false;
  let gestures = Date.now();
  const hues = new Map<string, number>();
  let between_ = 0;
  let dirty = true;
  let drawnAt = 0;
  let paneledAt = 0;
  let noted = 0;
  view.show.handles = true;
  view.show.messages = true;

  const line = connect(carrier, {
    open(on) {
      connected = on;
      assessed = -1;
      dirty = true;
      if (on) hush("connection");
      else say_("the connection to the session is gone; trying again", true, "connection");
      panel.update();
    },
    frame(data) {
      const found = unpack(data);
      if (!found || found.scene !== number || found.margins.length !== scene.count) return;
      if (now && found.round < now.round) past.clear();
      const at = performance.now();
      if (!now || found.round !== now.round) {
        past.add(found.round, found.margin, found.where);
        before = now;
        now = { ...found, at };
      } else now = { ...found, at: now.at };
      if (!scene.few) rescale(at);
      api.round = found.round;
      api.margin = found.margin;
      dirty = true;
    },
    message(message) {
      const told = TOLD[message.type as keyof typeof TOLD];
      if (told) told(message);
      dirty = true;
    },
  });

  let scaledAt = 0;
  function rescale(at: number): void {
    if (at - scaledAt < 500 || !now) return;
    scaledAt = at;
    scene.scale = scaleOf(now.margins);
  }

  const TOLD = {
    scene(message: Message) {
      const same = message.number === number;
      const chosen = view.show.chosen;
      const who = chosen?.kind === "agent" ? scene.ids[chosen.k] : null;
      const ids: string[] = message.ids;
      if (!same) {
        past.follow(scene.ids, ids, message.dimension);
        before = now = null;
        drag = null;
        view.show.held = null;
      }
      scene = {
        ...EMPTY,
        ...message,
        count: ids.length,
        few: ids.length <= FEW,
        space: message.dimension === 3,
        links: new Int32Array(message.links),
        outlines: same ? scene.outlines : [],
        scale: scene.scale,
        silent: [],
        cut: [],
      };
      if (scene.few) {
        for (const id of ids) if (!hues.has(id)) hues.set(id, hues.size);
        scene.hues = ids.map((id) => hues.get(id)!);
      }
      number = message.number;
      constraints = message.constraints;
      view.set(scene);
      part("name").textContent = scene.name;
      part("count").textContent = `${ids.length.toLocaleString("en")} agents${scene.few ? "" : ", the tightest first"}`;
      part("names").closest("label")!.hidden = !scene.few;
      const k = who === null ? -1 : ids.indexOf(who);
      view.show.chosen = k >= 0 ? { kind: "agent", k } : null;
      gone();
      panel.update();
    },
    shapes(message: Message) {
      if (message.number !== number) return;
      for (const [k, given] of Object.entries(message.balls as Record<string, { center: number[]; radius: number }>)) {
        if (drag?.begun && drag.held.kind !== "wall" && drag.held.kind !== "agent" && drag.held.k === Number(k)) continue;
        Object.assign(scene.balls[Number(k)], given);
      }
      view.reshape();
      if (message.walls && !(drag?.begun && drag.held.kind === "wall")) scene.walls = message.walls;
    },
    outlines(message: Message) {
      if (message.number === number) scene.outlines = message.outlines;
    },
    state(message: Message) {
      const { playing } = state;
      state = message;
      reached = message.revision;
      gone();
      part("play").textContent = state.playing ? "❚❚" : "▶";
      part("play").setAttribute("aria-label", state.playing ? "Pause" : "Play");
      if (playing !== state.playing) describe();
      part<HTMLSelectElement>("speed").value = String(state.speed);
      if (document.activeElement !== part("loss")) part<HTMLInputElement>("loss").value = String(state.loss);
      part("lost").textContent = `${Math.round(100 * state.loss)} %`;
      const chooser = part<HTMLSelectElement>("protocol");
      if (!chooser.length) chooser.append(...state.protocols.map((value) => new Option(value, value)));
      chooser.value = state.protocol;
      part<HTMLButtonElement>("undo").disabled = state.undo === 0;
      if (state.busy) say_(`${state.busy} …`, false, "busy");
      else hush("busy");
      panel.update();
    },
    verdict(message: Message) {
      verdict = message.verdict;
      bounds = message.bounds;
      reasons = message.reasons;
      assessed = message.revision;
      api.verdict = verdict;
      api.bounds = bounds;
      api.reasons = reasons;
      showVerdict();
      part("live").textContent = `${verdict}. ${reasons.join(" ")}`;
    },
    answer(message: Message) {
      reached = Math.max(reached, message.revision ?? 0);
      if (!message.ok) say_(message.words, true);
    },
  };

  // ---- words

  let notedFor = "";
  function say_(text: string, bad: boolean, reason = ""): void {
    if (reason === "busy" && !note.hidden && note.classList.contains("bad")) return;
    note.textContent = text;
    note.className = bad ? "note bad" : "note";
    note.setAttribute("role", bad ? "alert" : "status");
    note.hidden = false;
    notedFor = reason;
    noted += 1;
    const mine = noted;
    if (!reason) setTimeout(() => mine === noted && hush(), 6000);
  }
  function hush(reason = notedFor): void {
    if (notedFor === reason) note.hidden = true;
  }

  function showVerdict(): void {
    const out = part("verdict");
    const [lower, upper] = bounds ?? [null, null];
    const range =
      lower !== null && upper !== null
        ? say(lower) === say(upper)
          ? `best margin ${say(upper)}`
          : `best margin ${say(lower)} to ${say(upper)}`
        : upper !== null
          ? `best margin at most ${say(upper)}`
          : lower !== null
            ? `best margin at least ${say(lower)}`
            : "";
    const words = { feasible: "✓ feasible, proven", infeasible: "✗ can't be done, proven", undecided: "? undecided" }[verdict] ?? verdict;
    out.textContent = stale() ? `assessing … (before: ${verdict})` : [words, range].filter(Boolean).join("; ");
    out.className = stale() ? "stale" : verdict === "feasible" ? "good" : verdict === "infeasible" ? "bad" : "";
    const list = part("reasons");
    if (list.dataset.said !== reasons.join("\n")) {
      list.dataset.said = reasons.join("\n");
      list.replaceChildren(
        ...reasons.map((reason) => {
          const line = document.createElement("p");
          line.textContent = reason;
          return line;
        }),
      );
    }
    list.style.opacity = stale() ? "0.6" : "";
  }

  function describe(): void {
    if (!now) return;
    const doing = state.playing ? "running" : "paused";
    const text = `${scene.name}: ${scene.count} agents, ${doing}, round ${now.round}, margin ${say(now.margin)}`;
    stage.setAttribute("aria-label", `Formation of ${text}`);
    part("live").textContent = text;
  }

  /** Who was killed and which links were cut, as the view draws them. */
  function gone(): void {
    scene.silent = Object.entries(state.silent).map(([id, at]) => ({ id, at }));
    const place = (id: string): number[] | null => {
      const i = scene.ids.indexOf(id);
      return i < 0 || !now ? null : Array.from(now.where.subarray(i * scene.dimension, (i + 1) * scene.dimension));
    };
    scene.cut = state.cut.flatMap(([one, other]) => {
      const [a, b] = [place(one), place(other)];
      return a && b ? [[a, b] as [number[], number[]]] : [];
    });
  }

  // ---- drawing

  function frameNow(time: number): Frame | null {
    if (looking >= 0 && looking < past.length) {
      const where = past.at(looking);
      const margins = now?.margins ?? new Float32Array(scene.count);
      return {
        where,
        margins,
        headings: null,
        margin: past.margins[looking],
        step: past.rounds[looking],
        phase: 0,
        sample: Math.min(TRAIL, looking),
        moment: 0,
        past: past.last(looking + 1, TRAIL),
      };
    }
    if (!now) return null;
    const span = before ? Math.min(250, Math.max(1, now.at - before.at)) : 1;
    const share = before ? Math.min(1, (time - now.at) / span) : 1;
    let where = before ? between(before.where, now.where, share) : now.where;
    if (drag?.begun && drag.held.kind === "agent") {
      where = where.slice();
      where.set(drag.center, drag.held.k * scene.dimension);
    }
    const headings = before?.headings && now.headings ? turned(before.headings, now.headings, share) : now.headings;
    const history = past.last(past.length - (share < 1 || !scene.few ? 1 : 0), TRAIL);
    return { ...now, where, headings, step: now.round, phase: share % 1, sample: history.length, moment: 0, past: history };
  }

  function tick(time: number): void {
    requestAnimationFrame(tick);
    const passed = time - drawnAt;
    const moving = now && before && time - now.at < 300;
    if (!dirty && !moving) return;
    dirty = false;
    if (passed > 0 && passed < 1000) between_ = between_ ? 0.95 * between_ + 0.05 * passed : passed;
    drawnAt = time;
    const frame = frameNow(time);
    if (frame) {
      gone();
      view.draw(frame);
    }
    api.fps = between_ ? 1000 / between_ : 0;
    api.drawn += 1;
    if (time - paneledAt > 100) {
      paneledAt = time;
      tell(frame);
    }
  }

  function tell(frame: Frame | null): void {
    showVerdict();
    if (!frame) return;
    const { margin } = frame;
    part("margin").textContent = say(margin);
    part("margin").className = margin > 0 ? "good" : "bad";
    part("step").textContent = `round ${Math.round(frame.step)}`;
    part("state").textContent =
      looking >= 0
        ? "looking back"
        : !Number.isFinite(margin)
          ? ""
          : margin > 0
            ? "every constraint holds now"
            : "not every constraint holds now";
    slider.value = String(looking < 0 || past.length < 2 ? 1000 : Math.round((1000 * looking) / (past.length - 1)));
    slider.setAttribute("aria-valuetext", looking < 0 ? "now" : `round ${Math.round(frame.step)}`);
    chart.draw(
      {
        steps: past.rounds,
        margin: past.margins,
        count: past.length,
        clock: "round",
        bounds: stale() ? null : bounds,
        since: null,
        bound: null,
        verdicts: [],
      },
      frame,
    );
    table(frame);
  }

  function table({ margins }: Frame): void {
    const first = scene.few ? [...scene.ids.keys()] : tightest(margins, FEW);
    const least = Math.min(...first.map((i) => margins[i]).filter(Number.isFinite));
    const binds = (i: number) => margins[i] <= least + 0.02 * Math.abs(least) + 1e-4;
    const killed = Object.keys(state.silent).map((silent) => ({ silent }));
    rows(scene, margins, view.show.chosen, [...first.map((k) => ({ k, binds: binds(k) })), ...killed]);
  }

  // ---- orders

  async function order_(order: Record<string, unknown>): Promise<Answer> {
    return line.send(order);
  }

  function choose(chosen: typeof view.show.chosen): void {
    const old = view.show.chosen;
    view.show.chosen = old && chosen && old.kind === chosen.kind && old.k === chosen.k ? null : chosen;
    dirty = true;
    panel.update();
  }

  const panel = createPanel(part("panel"), {
    get: () => ({ scene, constraints, state, chosen: view.show.chosen, connected, where: now?.where ?? null }),
    order: order_,
    choose,
    /** By keyboard: a region moves by a fiftieth of the view, or changes its radius by a tenth. */
    nudge(agent, name, dx, dy, factor) {
      const k = scene.balls.findIndex((ball) => ball.names.some((each, j) => each === name && ball.owners[j] === agent));
      if (k < 0) return;
      const ball = scene.balls[k];
      const far = 0.02 * Math.max(...scene.high.map((high, axis) => high - scene.low[axis]));
      const center = ball.center.map((value, axis) => value + far * ([dx, dy][axis] ?? 0));
      const order = factor === 1 ? { center } : { radius: ball.radius * factor };
      Object.assign(ball, order);
      view.reshape();
      order_({ do: "shape", scene: number, shape: k, ...order });
      dirty = true;
    },
    addConstraint(agent, kind, text) {
      const place = Array.from(now?.where.subarray(agent * scene.dimension, (agent + 1) * scene.dimension) ?? []);
      const far = Math.max(...scene.high.map((high, axis) => high - scene.low[axis]));
      const [other, distance] = nearest(place, agent);
      const given: Record<string, Record<string, unknown>> = {
        within: { center: place, radius: far / 10 },
        outside: { center: place.map((value, axis) => value + (axis ? 0 : far / 8)), radius: far / 16 },
        near: { agent: other, radius: 1.5 * distance },
        apart: { agent: other, radius: 0.5 * distance },
        expr: { psi: text },
      };
      order_({ do: "add_constraint", agent: scene.ids[agent], constraint: { kind, ...given[kind] } });
    },
  });

  /** The agent nearest to a place, besides one, and how far it is. */
  function nearest(place: number[], besides: number): [string, number] {
    let best = "";
    let least = Number.POSITIVE_INFINITY;
    for (let i = 0; now && i < scene.count; i += 1) {
      const far = Math.hypot(...place.map((value, axis) => value - now!.where[i * scene.dimension + axis]));
      if (i !== besides && far < least) {
        least = far;
        best = scene.ids[i];
      }
    }
    return [best, least || 1];
  }

  function addAgent(px: number, py: number): void {
    const position = view.ground(px, py).map((value) => Number(value.toPrecision(6)));
    let k = scene.count + 1;
    while (scene.ids.includes(`a${k}`) || `a${k}` in state.silent) k += 1;
    const [other, distance] = nearest(position, -1);
    const near = { kind: "near", agent: other, radius: Number((1.2 * distance).toPrecision(3)) };
    order_({ do: "add", agent: `a${k}`, position, constraints: [near], links: [other] });
    toggleAdding(false);
  }

  function toggleAdding(on: boolean): void {
    adding = on;
    part("add").setAttribute("aria-pressed", String(on));
    stage.style.cursor = on ? "crosshair" : "";
    if (on) say_("click where the new agent shall be; Enter puts it into the middle", false, "adding");
    else hush("adding");
  }

  // ---- hands

  /** Send the newest of a drag; one at a time, so that a slow session is never flooded. */
  function push(of: Drag): void {
    if (of.waiting || !of.order) return;
    const { order } = of;
    of.order = null;
    of.waiting = true;
    const sent = performance.now();
    order_(order).then((answer) => {
      api.latency = performance.now() - sent;
      of.waiting = false;
      const ball = of.held.kind === "grip" || of.held.kind === "rim" ? scene.balls[of.held.k] : null;
      if (!answer.ok) {
        of.order = null;
        if (ball) Object.assign(ball, { center: of.center, radius: of.radius });
        view.reshape();
        if (drag === of) drag = null;
      } else {
        if (ball && order.scene === number) Object.assign(of, { center: order.center ?? of.center, radius: order.radius ?? of.radius });
        push(of);
      }
      dirty = true;
    });
  }

  function take(hit: Hit, at: Point): Drag | null {
    gestures += 1;
    const base = {
      gesture: gestures,
      from: at,
      begun: false,
      center: [] as number[],
      radius: 0,
      offset: 0,
      order: null,
      waiting: false,
      id: "",
    };
    switch (hit.kind) {
      case "agent":
        return { ...base, held: hit, id: scene.ids[hit.k] };
      case "grip":
      case "rim": {
        const ball: Ball = scene.balls[hit.k];
        return { ...base, held: hit, center: [...ball.center], radius: ball.radius };
      }
      case "wall":
        return { ...base, held: hit, offset: scene.walls[hit.k].offset };
      default:
        return null;
    }
  }

  let grabbed: number[] = [];
  function pull(of: Drag, at: Point): void {
    const [dx, dy] = [at[0] - of.from[0], at[1] - of.from[1]];
    if (!of.begun) {
      if (Math.hypot(dx, dy) <= 4) return;
      of.begun = true;
      const { held } = of;
      if (held.kind === "agent") grabbed = Array.from(now!.where.subarray(held.k * scene.dimension, (held.k + 1) * scene.dimension));
      else grabbed = held.kind === "grip" ? [...scene.balls[held.k].center] : [];
      part("hint").hidden = true;
      tip.hidden = true;
    }
    const round = (values: number[]) => values.map((value) => Number(value.toPrecision(7)));
    const { held } = of;
    if (held.kind === "agent") {
      of.center = round(view.moved(grabbed, dx, dy));
      of.order = { do: "place", agent: of.id, position: of.center, gesture: of.gesture };
    } else if (held.kind === "grip") {
      const center = round(view.moved(grabbed, dx, dy));
      scene.balls[held.k].center = center;
      of.order = { do: "shape", scene: number, shape: held.k, center, gesture: of.gesture };
    } else if (held.kind === "rim") {
      const ball = scene.balls[held.k];
      const [mx, my] = view.middle(ball);
      const radius = Number(Math.max(4 / view.scale, Math.hypot(at[0] - mx, at[1] - my) / view.scale).toPrecision(6));
      ball.radius = radius;
      of.order = { do: "shape", scene: number, shape: held.k, radius, gesture: of.gesture };
    } else {
      const wall = scene.walls[held.k];
      const step = view.moved([0, 0], dx, dy).reduce((sum, value, axis) => sum + value * wall.normal[axis], 0);
      const offset = Number((of.offset + step).toPrecision(7));
      const shift = offset - wall.offset;
      wall.corners = wall.corners.map((corner) => corner.map((value, axis) => value + shift * (wall.normal[axis] ?? 0)));
      wall.offset = offset;
      of.order = { do: "wall", scene: number, wall: wall.place, offset, gesture: of.gesture };
    }
    dirty = true;
    push(of);
  }

  let pressed: Hit | null = null;
  const reachOf = (event: PointerEvent) => (event.pointerType === "touch" ? TOUCH : MOUSE);
  const redraw = () => {
    dirty = true;
  };

  watchHands(stage, view, () => scene.space, redraw, {
    press(at, event) {
      pressed = looking < 0 && !adding ? view.hit(...at, reachOf(event)) : null;
      drag = pressed && event.button === 0 && !event.shiftKey ? take(pressed, at) : null;
      view.show.held = drag && drag.held.kind !== "agent" ? drag.held : null;
      return drag !== null;
    },
    pull(at) {
      if (drag) pull(drag, at);
      return drag?.begun === true;
    },
    drop() {
      if (drag?.begun && drag.held.kind !== "agent") push(drag);
      drag = null;
      view.show.held = null;
    },
    click(at) {
      if (adding) addAgent(...at);
      else if (pressed?.kind === "agent" || pressed?.kind === "link") choose({ kind: pressed.kind, k: pressed.k });
      else if (pressed?.kind === "grip" || pressed?.kind === "rim") choose({ kind: "agent", k: scene.balls[pressed.k].owners[0] });
      else if (view.show.chosen) choose(view.show.chosen);
    },
    hover(at, event) {
      if (at) hover(at, reachOf(event));
      else {
        tip.hidden = true;
        if (!drag) view.show.held = null;
        dirty = true;
      }
    },
  });

  function hover(at: Point, reach: number): void {
    const hit = looking < 0 ? view.hit(...at, reach) : null;
    const held: Held | null = hit && (hit.kind === "grip" || hit.kind === "rim" || hit.kind === "wall") ? hit : null;
    if (view.show.held?.k !== held?.k || view.show.held?.kind !== held?.kind) dirty = true;
    view.show.held = held;
    stage.style.cursor = adding
      ? "crosshair"
      : !hit
        ? "grab"
        : hit.kind === "rim"
          ? "nwse-resize"
          : hit.kind === "link"
            ? "pointer"
            : "move";
    tellAt(tip, stage, told(hit), at);
  }

  function told(hit: Hit | null): string {
    if (!hit || !now) return "";
    if (hit.kind === "agent") return agentInWords(scene, hit.k, now.where, now.margins[hit.k]);
    if (hit.kind === "link") return `link ${scene.ids[scene.links[2 * hit.k]]} – ${scene.ids[scene.links[2 * hit.k + 1]]}`;
    const shape = hit.kind === "wall" ? scene.walls[hit.k] : scene.balls[hit.k];
    const [owner, name] = [scene.ids[shape.owners[0]], shape.names[0]];
    const more = shape.owners.length > 1 ? ` and ${shape.owners.length - 1} more` : "";
    const size = hit.kind === "rim" ? `, radius ${say(scene.balls[hit.k].radius)}` : "";
    return `${owner}: ${name}${more}${size}`;
  }

  // ---- buttons and keys

  const click = (name: string, act: () => void) => part(name).addEventListener("click", act);
  const fit = () => {
    if (now) Object.assign(scene, extent(scene, now.where));
    view.fit();
    dirty = true;
  };
  const look = (k: number) => {
    looking = k < 0 || k >= past.length - 1 ? -1 : k;
    dirty = true;
  };
  const play = () => {
    look(-1);
    order_({ do: state.playing ? "pause" : "play" });
  };
  const step = () => {
    look(-1);
    if (state.playing) order_({ do: "pause" });
    order_({ do: "step", rounds: 1 });
  };
  const undo = () => order_({ do: "undo" });
  click("play", play);
  click("next", step);
  click("undo", undo);
  click("restart", () => order_({ do: "restart" }));
  click("add", () => toggleAdding(!adding));
  click("copy", async () => {
    const answer = await order_({ do: "text" });
    if (!answer.ok || answer.text === undefined) return;
    await copied(answer.text);
  });
  async function copied(text: string): Promise<void> {
    if (navigator.clipboard) {
      try {
        await navigator.clipboard.writeText(text);
        say_("the scenario as it is now is on the clipboard", false);
        return;
      } catch {
        // Not allowed: it is shown instead.
      }
    }
    const box = document.createElement("textarea");
    box.value = text;
    box.rows = 12;
    box.readOnly = true;
    box.setAttribute("aria-label", "The scenario as it is now");
    panel.show(box);
    box.select();
  }
  slider.addEventListener("input", () => look(Math.round((Number(slider.value) / 1000) * (past.length - 1))));
  part("chart").addEventListener("pointerdown", (event) => {
    const at = chart.stepAt(event.offsetX);
    look(past.rounds.findIndex((round) => round >= at));
  });
  part<HTMLSelectElement>("speed").append(...SPEEDS.map((value) => new Option(`${value} rounds/s`, String(value))));
  part("speed").addEventListener("change", () => order_({ do: "speed", rounds: Number(part<HTMLSelectElement>("speed").value) }));
  part("protocol").addEventListener("change", () => order_({ do: "protocol", kind: part<HTMLSelectElement>("protocol").value }));
  part("loss").addEventListener("input", () => {
    part("lost").textContent = `${Math.round(100 * Number(part<HTMLInputElement>("loss").value))} %`;
  });
  part("loss").addEventListener("change", () => order_({ do: "loss", share: Number(part<HTMLInputElement>("loss").value) }));
  function away(): void {
    const { chosen } = view.show;
    if (chosen?.kind === "agent") order_({ do: "kill", agent: scene.ids[chosen.k] });
    else if (chosen)
      order_({ do: "disconnect", one: scene.ids[scene.links[2 * chosen.k]], other: scene.ids[scene.links[2 * chosen.k + 1]] });
  }

  document.addEventListener("keydown", (event) => {
    const on = event.target;
    if (on instanceof HTMLSelectElement || on instanceof HTMLTextAreaElement || event.altKey) return;
    if (on instanceof HTMLInputElement && on.type !== "checkbox") return;
    if ((event.ctrlKey || event.metaKey) && event.key !== "z") return;
    const keys: Record<string, () => void> = {
      " ": play,
      k: play,
      ArrowRight: step,
      ArrowLeft: () => look((looking < 0 ? past.length - 1 : looking) - 1),
      z: undo,
      f: fit,
      "+": () => view.zoom(1.2),
      "-": () => view.zoom(1 / 1.2),
      Delete: away,
      Enter: () => adding && addAgent(stage.clientWidth / 2, stage.clientHeight / 2),
      Escape: () => {
        toggleAdding(false);
        look(-1);
        if (view.show.chosen) choose(view.show.chosen);
      },
    };
    const onButton = on instanceof HTMLButtonElement || on instanceof HTMLInputElement;
    if (!keys[event.key] || (onButton && (event.key === " " || event.key === "Enter"))) return;
    event.preventDefault();
    keys[event.key]();
    dirty = true;
  });

  const inPage = (at: Point | null): Point | null => {
    const box = stage.getBoundingClientRect();
    return at && [at[0] + box.left, at[1] + box.top];
  };
  const api = {
    round: 0,
    margin: Number.NaN,
    verdict,
    bounds: null as [number | null, number | null] | null,
    reasons: [] as string[],
    fps: 0,
    drawn: 0,
    latency: Number.NaN,
    agents: () => [...scene.ids],
    /** Where an agent is, in page pixels. */
    where: (id: string) => inPage(view.where(scene.ids.indexOf(id) < 0 ? scene.count : scene.ids.indexOf(id))),
    /** Where a region can be taken hold of, in page pixels. */
    handle(agent: string, constraint: string): Point | null {
      const owner = scene.ids.indexOf(agent);
      const mine = (shape: { owners: number[]; names: string[] }) =>
        shape.names.some((name, k) => shape.owners[k] === owner && (name === constraint || name.startsWith(`${constraint}.`)));
      const k = scene.balls.findIndex(mine);
      if (k >= 0) {
        if (scene.balls[k].around < 0) return inPage(view.grip(k));
        const [x, y] = view.middle(scene.balls[k]);
        return inPage([x + scene.balls[k].radius * view.scale, y]);
      }
      const walls = [...scene.walls.keys()].filter((place) => mine(scene.walls[place]));
      for (const place of walls) {
        const [from, to] = view.line(scene.walls[place]);
        for (let step = 0; step < 98; step += 1) {
          const t = 0.5 + ((step % 2 ? 1 : -1) * Math.ceil(step / 2)) / 100;
          const at: Point = [from[0] + t * (to[0] - from[0]), from[1] + t * (to[1] - from[1])];
          const seen = at[0] > 0 && at[1] > 0 && at[0] < stage.clientWidth && at[1] < stage.clientHeight;
          const hit = seen ? view.hit(...at, MOUSE) : null;
          if (hit?.kind === "wall" && hit.k === place) return inPage(at);
        }
      }
      return null;
    },
    send: (message: Record<string, unknown>) => order_(message),
  };

  const dark = bindControls(part, view, chart, redraw, fit);
  const rows = createRows(part("rows"), dark, (who) => {
    if ("silent" in who) order_({ do: "revive", agent: who.silent });
    else choose({ kind: "agent", k: who.k });
  });
  requestAnimationFrame(tick);
  return api;
}
