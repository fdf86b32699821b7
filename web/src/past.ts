// The last rounds, for paths, the chart and looking back. It never grows beyond a bound.

import type { History } from "./model";

const MOST_ROUNDS = 1200;
const MOST_NUMBERS = 4_000_000;

export function createPast() {
  let rounds: number[] = [];
  let margins: number[] = [];
  let places: Float32Array[] = [];

  return {
    get length() {
      return places.length;
    },
    get rounds() {
      return rounds;
    },
    get margins() {
      return margins;
    },
    at: (k: number): Float32Array => places[k],
    add(round: number, margin: number, where: Float32Array): void {
      rounds.push(round);
      margins.push(margin);
      places.push(where);
      const most = Math.max(2, Math.min(MOST_ROUNDS, Math.floor(MOST_NUMBERS / Math.max(1, where.length))));
      if (places.length > 1.1 * most) {
        rounds = rounds.slice(-most);
        margins = margins.slice(-most);
        places = places.slice(-most);
      }
    },
    clear(): void {
      rounds = [];
      margins = [];
      places = [];
    },
    /** Other agents from now on: those who were not there were nowhere. */
    follow(before: string[], after: string[], d: number): void {
      const from = new Map(before.map((id, i) => [id, i]));
      places = places.map((old) => {
        const found = new Float32Array(after.length * d).fill(Number.NaN);
        after.forEach((id, i) => {
          const k = from.get(id);
          if (k !== undefined && old.length === before.length * d) found.set(old.subarray(k * d, (k + 1) * d), i * d);
        });
        return found;
      });
    },
    /** The last `most` of the first `count`. */
    last(count: number, most: number): History {
      const first = Math.max(0, count - most);
      return { length: Math.max(0, count - first), at: (k) => places[first + k], name: `${rounds[first]} ${rounds[count - 1]}` };
    },
  };
}
