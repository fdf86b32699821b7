// What is chosen, an agent or a link, and what can be done with it.

import type { State } from "./live";
import type { Scene } from "./model";
import type { Answer } from "./socket";
import type { Chosen } from "./view";

interface Team {
  scene: Scene;
  constraints: [number, string][];
  state: State;
  chosen: Chosen;
  connected: boolean;
  where: Float32Array | null;
}

interface Doings {
  get(): Team;
  order(order: Record<string, unknown>): Promise<Answer>;
  choose(chosen: Chosen): void;
  nudge(agent: number, constraint: string, dx: number, dy: number, factor: number): void;
  addConstraint(agent: number, kind: string, text: string): void;
}

const KINDS = ["within", "outside", "near", "apart", "expr"];
const ARROWS: Record<string, [number, number, number]> = {
  ArrowLeft: [-1, 0, 1],
  ArrowRight: [1, 0, 1],
  ArrowUp: [0, 1, 1],
  ArrowDown: [0, -1, 1],
  "+": [0, 0, 1.1],
  "-": [0, 0, 1 / 1.1],
};

function make<K extends keyof HTMLElementTagNameMap>(tag: K, text = "", attributes: Record<string, string> = {}): HTMLElementTagNameMap[K] {
  const found = document.createElement(tag);
  found.textContent = text;
  for (const [name, value] of Object.entries(attributes)) found.setAttribute(name, value);
  return found;
}

function button(text: string, label: string, act: () => void, kind = "quiet"): HTMLButtonElement {
  const found = make("button", text, { type: "button", class: kind, "aria-label": label, title: label });
  found.addEventListener("click", act);
  return found;
}

function row(...children: HTMLElement[]): HTMLElement {
  const found = make("div", "", { class: "row" });
  found.append(...children);
  return found;
}

export function createPanel(root: HTMLElement, doings: Doings) {
  let drawn = "";
  let shown: HTMLElement | null = null;

  function ofLink(team: Team, k: number): HTMLElement[] {
    const { scene } = team;
    const [one, other] = [scene.ids[scene.links[2 * k]], scene.ids[scene.links[2 * k + 1]]];
    const cut = button("cut the link", `Cut the link between ${one} and ${other}`, () => doings.order({ do: "disconnect", one, other }));
    const buttons = make("p", "", { class: "buttons" });
    buttons.append(cut);
    return [make("h2", `link ${one} – ${other}`), buttons];
  }

  function ofAgent(team: Team, i: number): HTMLElement[] {
    const { scene, state } = team;
    const id = scene.ids[i];
    const found: HTMLElement[] = [make("h2", `agent ${id}`)];
    const buttons = make("p", "", { class: "buttons" });
    buttons.append(
      button("kill", `Kill ${id}: it falls silent, and can be revived`, () => doings.order({ do: "kill", agent: id })),
      button("remove", `Remove ${id} from the team`, () => doings.order({ do: "remove", agent: id })),
    );
    found.push(buttons, make("h3", "constraints"));
    const own = new Set(team.constraints.filter(([owner]) => owner === i).map(([, name]) => name.replace(/\.(low|high)\[\d+\]$/, "")));
    for (const name of own) {
      const ball = scene.balls.find((each) => each.names.some((other, j) => other === name && each.owners[j] === i));
      const knob = button(
        name,
        ball ? `${name} of ${id}: arrow keys move it, plus and minus change its radius` : `${name} of ${id}`,
        () => {},
        "knob",
      );
      knob.addEventListener("keydown", (event) => {
        const arrow = ARROWS[event.key];
        if (!arrow) return;
        event.preventDefault();
        event.stopPropagation();
        if (ball) doings.nudge(i, name, ...arrow);
      });
      found.push(
        row(
          knob,
          button(
            "×",
            `Remove the constraint ${name} of ${id}`,
            () => doings.order({ do: "remove_constraint", agent: id, constraint: name }),
            "tiny",
          ),
        ),
      );
    }
    if (!own.size) found.push(make("p", "none", { class: "small" }));
    const kind = make("select", "", { "aria-label": "Kind of the new constraint" });
    kind.append(...KINDS.map((each) => new Option(each, each)));
    const text = make("input", "", { type: "text", "aria-label": "Expression", placeholder: `1 - norm2(${id} - [2, 0])`, size: "12" });
    text.hidden = true;
    kind.addEventListener("change", () => {
      text.hidden = kind.value !== "expr";
    });
    found.push(
      row(
        kind,
        text,
        button("add", `Give ${id} this constraint`, () => doings.addConstraint(i, kind.value, text.value), "tiny"),
      ),
    );
    found.push(make("h3", "talks to"));
    const ends: string[] = [];
    for (let k = 0; k < scene.links.length; k += 2) {
      if (scene.links[k] === i) ends.push(scene.ids[scene.links[k + 1]]);
      if (scene.links[k + 1] === i) ends.push(scene.ids[scene.links[k]]);
    }
    for (const other of ends) {
      const cut = button(
        "cut",
        `Cut the link between ${id} and ${other}`,
        () => doings.order({ do: "disconnect", one: id, other }),
        "tiny",
      );
      found.push(row(make("span", other), cut));
    }
    for (const pair of state.cut.filter((each) => each.includes(id))) {
      const other = pair[0] === id ? pair[1] : pair[0];
      const heal = button(
        "heal",
        `Heal the link between ${id} and ${other}`,
        () => doings.order({ do: "connect", one: id, other }),
        "tiny",
      );
      found.push(row(make("span", `${other} (cut)`), heal));
    }
    return found;
  }

  function ofCuts(team: Team): HTMLElement[] {
    return team.state.cut.map(([one, other]) =>
      row(
        make("span", `link ${one} – ${other} is cut`),
        button("heal", `Heal the link between ${one} and ${other}`, () => doings.order({ do: "connect", one, other }), "tiny"),
      ),
    );
  }

  function update(): void {
    const team = doings.get();
    const { scene, chosen, constraints, state } = team;
    const key = JSON.stringify([
      chosen,
      scene.ids.length > 500 ? scene.ids.length : scene.ids,
      constraints.length,
      scene.links.length,
      state.cut,
      constraints.slice(0, 500),
    ]);
    if (key === drawn) return;
    drawn = key;
    const found = !chosen ? ofCuts(team) : chosen.kind === "agent" ? ofAgent(team, chosen.k) : ofLink(team, chosen.k);
    if (shown) found.push(shown);
    const label =
      document.activeElement && root.contains(document.activeElement) ? document.activeElement.getAttribute("aria-label") : null;
    root.replaceChildren(...found);
    root.hidden = !found.length;
    if (label) [...root.querySelectorAll<HTMLElement>("[aria-label]")].find((each) => each.getAttribute("aria-label") === label)?.focus();
  }

  return {
    update,
    show(element: HTMLElement): void {
      shown?.remove();
      shown = element;
      root.append(element);
      root.hidden = false;
    },
  };
}
