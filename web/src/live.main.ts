// The script of the live page.

import { createLive } from "./live";

Object.assign(window, { consat: createLive(document.body) });
