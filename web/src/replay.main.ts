// The script of the offline replay, which must hold nothing that connects.

import { decode } from "./decode";
import { createPlayer } from "./replay";

const run = document.getElementById("run");
Object.assign(window, { consat: createPlayer(document.body, decode(JSON.parse(run?.textContent ?? ""))) });
