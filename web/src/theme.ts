// Colours that the colour-blind can tell apart (Okabe and Ito), on light and on dark.

const AGENTS = ["#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000"];
const AGENTS_DARK = ["#4FB0EE", "#FF8F50", "#31D1A0", "#E8A3CC", "#F5BF45", "#9AD8FA", "#F0F0F0"];

export const VERDICTS: Record<string, string> = { feasible: "#009E73", infeasible: "#D55E00", undecided: "#9aa0a8" };

export interface Theme {
  paper: string;
  ink: string;
  grid: string;
  axis: string;
  link: string;
  trail: string;
  bar: string;
  area: string;
  bad: string;
  /** Of obstacles, and of the edges of what is solid. */
  solid: string;
  edge: string;
  agents: string[];
}

export const THEMES = {
  light: {
    paper: "#ffffff",
    ink: "#1c2430",
    grid: "#e8ebef",
    axis: "#6b7480",
    link: "#4d5663",
    trail: "#dccaa4",
    bar: "#4a4a4a",
    area: "#0072B2",
    bad: "#D55E00",
    solid: "#9e9e9e",
    edge: "#404040",
    agents: AGENTS,
  },
  dark: {
    paper: "#12171e",
    ink: "#e8ecf1",
    grid: "#252d37",
    axis: "#93a0ae",
    link: "#9aa7b5",
    trail: "#6b5f45",
    bar: "#b9bfc7",
    area: "#56B4E9",
    bad: "#FF8F50",
    solid: "#5d636b",
    edge: "#c3c8ce",
    agents: AGENTS_DARK,
  },
} satisfies Record<string, Theme>;

export type ThemeName = keyof typeof THEMES;
