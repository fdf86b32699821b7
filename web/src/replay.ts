// Player of a recorded run: buttons, keys, the margin's chart, the table.

import { createChart } from "./chart";
import { agentInWords, bindControls, createRows, tellAt, watchHands } from "./controls";
import { frameAt, type Recording } from "./decode";
import { type Point, tightest } from "./geometry";
import { FEW, type Frame, say } from "./model";
import { parts } from "./page";
import { createView } from "./view";

const SPEEDS = [0.25, 0.5, 1, 2, 4];

export function createPlayer(root: HTMLElement, run: Recording) {
  const part = parts(root);
  const stage = part<HTMLCanvasElement>("stage");
  const slider = part<HTMLInputElement>("slider");
  const play = part("play");
  const tip = part("tip");
  const live = part("live");
  const view = createView(stage, run);
  const chart = createChart(part<HTMLCanvasElement>("chart"));
  const series = { ...run, count: run.samples };
  let moment = 0;
  let playing = false;
  let speed = 1;
  let before = 0;
  let fps = 0;
  let ready = false;
  let share = 0;
  const seconds = Math.min(20, Math.max(6, run.samples / 20));
  // Most happens at the beginning: moments are spread by the way travelled as much as by the clock.
  const { spread } = run;
  const momentOf = (at: number) => {
    const s = Math.min(Math.max(at, 0), 1) * (spread.length - 1);
    const a = Math.floor(s);
    const b = Math.min(a + 1, spread.length - 1);
    return spread[a] + (s - a) * (spread[b] - spread[a]);
  };
  const shareOf = (at: number) => {
    let a = 0;
    while (a < spread.length - 2 && spread[a + 1] <= at) a += 1;
    const gap = spread[a + 1] - spread[a];
    return (a + (gap > 0 ? Math.min(1, (at - spread[a]) / gap) : 0)) / (spread.length - 1);
  };

  function paint(): Frame {
    const frame = frameAt(run, moment);
    view.draw(frame);
    chart.draw(series, frame);
    part("step").textContent = run.clock === "time" ? `t = ${frame.step.toFixed(1)} s` : `round ${Math.round(frame.step)}`;
    part("margin").textContent = say(frame.margin);
    part("margin").className = frame.margin > 0 ? "good" : "bad";
    part("state").textContent = !Number.isFinite(frame.margin)
      ? ""
      : frame.margin > 0
        ? "every constraint holds now"
        : "not every constraint holds now";
    slider.value = String(Math.round(1000 * share));
    slider.setAttribute("aria-valuetext", part("step").textContent ?? "");
    const shown = run.few ? [...run.ids.keys()] : tightest(frame.margins, FEW);
    rows(
      run,
      frame.margins,
      view.show.chosen,
      shown.map((k) => ({ k, binds: false })),
    );
    Object.assign(api, { round: frame.step, margin: frame.margin, fps });
    return frame;
  }

  function describe(): void {
    const frame = paint();
    const text = `${run.name}: ${run.count} agents, ${part("step").textContent}, margin ${say(frame.margin)}`;
    stage.setAttribute("aria-label", `Formation of ${text}`);
    live.textContent = text;
  }

  function tick(now: number): void {
    if (!playing) return;
    const passed = Math.min(0.1, (now - before) / 1000);
    if (passed > 0) fps = fps ? 0.9 * fps + 0.1 / passed : 1 / passed;
    before = now;
    share = Math.min(1, share + (speed * passed) / seconds);
    moment = momentOf(share);
    if (share >= 1) {
      toggle(false);
      return;
    }
    paint();
    requestAnimationFrame(tick);
  }

  function toggle(on = !playing): void {
    playing = on;
    play.textContent = on ? "❚❚" : "▶";
    play.setAttribute("aria-label", on ? "Pause" : "Play");
    if (on) {
      if (share >= 1) share = 0;
      before = performance.now();
      requestAnimationFrame(tick);
    } else describe();
  }

  function seek(at: number): void {
    moment = Math.min(Math.max(at, 0), run.samples - 1);
    share = shareOf(moment);
    if (playing) paint();
    else describe();
  }

  function choose(i: number): void {
    const same = view.show.chosen?.kind === "agent" && view.show.chosen.k === i;
    view.show.chosen = same || i < 0 ? null : { kind: "agent", k: i };
    describe();
  }

  function back(): void {
    toggle(false);
    seek(Math.ceil(moment) - 1);
  }

  function next(): void {
    toggle(false);
    seek(Math.floor(moment) + 1);
  }

  part("back").addEventListener("click", back);
  part("next").addEventListener("click", next);
  play.addEventListener("click", () => toggle());
  slider.addEventListener("input", () => {
    if (playing) toggle(false);
    share = Number(slider.value) / 1000;
    moment = momentOf(share);
    describe();
  });
  part<HTMLSelectElement>("speed").addEventListener("change", (event) => {
    speed = Number((event.target as HTMLSelectElement).value);
  });
  if (!run.few) {
    view.show.names = false;
    part("names").closest("label")!.hidden = true;
  }
  part("chart").addEventListener("pointerdown", (event) => {
    toggle(false);
    const step = chart.stepAt(event.offsetX);
    let s = 0;
    while (s < run.samples - 1 && run.steps[s + 1] <= step) s += 1;
    seek(s);
  });
  document.addEventListener("keydown", (event) => {
    const on = event.target;
    if (on instanceof HTMLSelectElement || event.altKey || event.ctrlKey || event.metaKey) return;
    const pressed = on instanceof HTMLButtonElement || (on instanceof HTMLInputElement && on.type === "checkbox");
    const keys: Record<string, () => void> = {
      " ": () => toggle(),
      k: () => toggle(),
      ArrowLeft: back,
      ArrowRight: next,
      Home: () => seek(0),
      End: () => {
        toggle(false);
        seek(run.samples - 1);
      },
      "+": () => {
        view.zoom(1.2);
        paint();
      },
      "-": () => {
        view.zoom(1 / 1.2);
        paint();
      },
      f: () => {
        view.fit();
        paint();
      },
      Escape: () => choose(-1),
    };
    if (!keys[event.key] || (pressed && event.key === " ") || (on === slider && event.key !== " ")) return;
    event.preventDefault();
    keys[event.key]();
  });

  const under = (at: Point) => {
    const hit = view.hit(...at, 14);
    return hit?.kind === "agent" ? hit.k : -1;
  };
  watchHands(stage, view, () => run.space, paint, {
    press: () => false,
    pull: () => false,
    drop() {},
    click: (at) => choose(under(at)),
    hover(at) {
      const i = at ? under(at) : -1;
      stage.style.cursor = i < 0 ? "grab" : "pointer";
      const frame = i < 0 ? null : frameAt(run, moment);
      tellAt(tip, stage, frame ? agentInWords(run, i, frame.where, frame.margins[i]) : "", at ?? [0, 0]);
    },
  });
  stage.addEventListener("dblclick", () => {
    view.fit();
    paint();
  });

  for (const value of SPEEDS) {
    const option = new Option(`${value}×`, String(value), value === 1, value === 1);
    part<HTMLSelectElement>("speed").append(option);
  }
  const api = {
    round: 0,
    margin: Number.NaN,
    verdict: run.verdict,
    fps: 0,
    agents: () => [...run.ids],
    where: (id: string) => {
      const i = run.ids.indexOf(id);
      const at = i < 0 ? null : view.where(i);
      const box = stage.getBoundingClientRect();
      return at && [at[0] + box.left, at[1] + box.top];
    },
    seek,
    toggle,
  };
  const dark = bindControls(part, view, chart, () => {
    if (ready) paint();
  });
  const rows = createRows(part("rows"), dark, (who) => {
    if ("k" in who) choose(who.k);
  });
  ready = true;
  describe();
  if (!window.matchMedia("(prefers-reduced-motion: reduce)").matches) toggle(true);
  else {
    share = 1;
    seek(run.samples - 1);
  }
  return api;
}
