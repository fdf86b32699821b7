// The script of both pages: a document with a recorded run is replayed, any other shows the session that it came from.

import { decode } from "./decode";
import { createLive } from "./live";
import { createPlayer } from "./replay";

declare global {
  interface Window {
    consat: unknown;
  }
}

const run = document.getElementById("run");
window.consat = run ? createPlayer(document.body, decode(JSON.parse(run.textContent ?? ""))) : createLive(document.body);
