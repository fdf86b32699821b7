// The script of the live page: served, its messages travel over a socket; framed by a notebook's widget, over a port.

import { createLive } from "./live";
import { overPort, overSocket } from "./socket";

const framed = window.location.href === "about:srcdoc";
Object.assign(window, { consat: createLive(document.body, framed ? overPort(window) : overSocket(window.location)) });
