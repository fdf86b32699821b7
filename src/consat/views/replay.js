// Replay of a run. Four parts that know each other only through plain data:
//   decode(document)            -> scene   what never changes: ids, links, regions, recorded arrays
//   frameAt(scene, moment)      -> frame   where everybody is at a moment (a sample, or between two)
//   createView(canvas, scene)   -> view    view.draw(frame) draws one frame; view.fit, view.pan, view.zoom, view.orbit, view.pick
//   createPlayer(root, scene)              buttons, keys, the margin's chart, the table; calls the other three
// A live page replaces decode and createPlayer; scene, frame and view stay.
"use strict";
(() => {
  const AGENTS = ["#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000"];
  const AGENTS_DARK = ["#4FB0EE", "#FF8F50", "#31D1A0", "#E8A3CC", "#F5BF45", "#9AD8FA", "#F0F0F0"];
  const FEW = 12, MOST_SEGMENTS = 30000, SPEEDS = [0.25, 0.5, 1, 2, 4];
  const VERDICTS = { feasible: "#009E73", infeasible: "#D55E00", undecided: "#9aa0a8" };
  const THEMES = {
    light: { paper: "#ffffff", ink: "#1c2430", grid: "#e8ebef", axis: "#6b7480", link: "#4d5663", trail: "#dccaa4", bar: "#4a4a4a", area: "#0072B2", solid: "#9e9e9e", edge: "#404040", agents: AGENTS },
    dark: { paper: "#12171e", ink: "#e8ecf1", grid: "#252d37", axis: "#93a0ae", link: "#9aa7b5", trail: "#6b5f45", bar: "#b9bfc7", area: "#56B4E9", solid: "#5d636b", edge: "#c3c8ce", agents: AGENTS_DARK },
  };

  // ---- data

  function bytes(text) {
    const raw = atob(text), out = new Uint8Array(raw.length);
    for (let i = 0; i < raw.length; i += 1) out[i] = raw.charCodeAt(i);
    return out.buffer;
  }

  function decode(data) {
    const floats = (text) => new Float32Array(bytes(text));
    const scene = { ...data, x: floats(data.x), steps: floats(data.steps), margin: floats(data.margin), agentMargin: floats(data.agent_margin) };
    scene.links = new Int32Array(bytes(data.links));
    scene.bound = data.bound === null ? null : floats(data.bound);
    scene.heading = data.bodies && data.bodies.heading ? floats(data.bodies.heading) : null;
    scene.count = data.ids.length;
    scene.samples = scene.steps.length;
    scene.few = scene.count <= FEW;
    scene.space = data.dimension === 3;
    return scene;
  }

  function frameAt(scene, moment) {
    const { count, dimension: d, x } = scene, at = Math.min(Math.max(moment, 0), scene.samples - 1);
    const a = Math.floor(at), b = Math.min(a + 1, scene.samples - 1), share = at - a, size = count * d;
    const where = new Float32Array(size);
    for (let k = 0; k < size; k += 1) where[k] = (1 - share) * x[a * size + k] + share * x[b * size + k];
    let heading = null;
    if (scene.heading) { // the shorter way round
      heading = new Float32Array(count);
      for (let i = 0; i < count; i += 1) {
        const first = scene.heading[a * count + i], turn = scene.heading[b * count + i] - first;
        heading[i] = first + share * Math.atan2(Math.sin(turn), Math.cos(turn));
      }
    }
    return {
      moment: at, sample: a, where, heading,
      step: (1 - share) * scene.steps[a] + share * scene.steps[b],
      margins: scene.agentMargin.subarray(a * count, (a + 1) * count),
      margin: scene.margin[a],
    };
  }

  // The colour of a margin: shades[k] is that of margins from edges[k - 1] to edges[k].
  function shadeOf(scene, margin) {
    const { edges, shades } = scene.scale;
    if (!Number.isFinite(margin)) return "#b8bec6";
    let k = 0;
    while (k < edges.length && margin >= edges[k]) k += 1;
    return shades[k];
  }

  // ---- view: frame -> picture

  function createView(canvas, scene) {
    const pen = canvas.getContext("2d"), d = scene.dimension;
    let theme = THEMES.light, width = 1, height = 1, ratio = 1, scale = 1, center = [0, 0, 0], yaw = -0.9, pitch = 0.45, last = null, dots = null;
    const show = { trails: true, links: true, regions: true, names: scene.few, chosen: -1 };
    const low = scene.low, high = scene.high;

    function fit() {
      for (let k = 0; k < 3; k += 1) center[k] = k < d ? (low[k] + high[k]) / 2 : 0;
      if (scene.space) {
        let reach = 0;
        for (let k = 0; k < 3; k += 1) reach += ((high[k] - low[k]) / 2) ** 2;
        scale = Math.min(width, height) / (2.1 * Math.sqrt(reach));
      } else scale = 0.94 * Math.min(width / (high[0] - low[0]), height / ((d > 1 ? high[1] - low[1] : high[0] - low[0]) || 1));
    }

    function resize() {
      ratio = Math.max(1, window.devicePixelRatio || 1);
      width = Math.max(1, canvas.clientWidth); height = Math.max(1, canvas.clientHeight);
      canvas.width = Math.round(width * ratio); canvas.height = Math.round(height * ratio);
      dots = null;
      fit();
      if (last) draw(last);
    }

    // The place of a point in the picture, and in space how near it is.
    function project(x, y, z) {
      const u = x - center[0], v = y - center[1], w = z - center[2];
      if (!scene.space) return [width / 2 + scale * u, height / 2 - scale * v, 0];
      const cy = Math.cos(yaw), sy = Math.sin(yaw), cp = Math.cos(pitch), sp = Math.sin(pitch);
      const right = cy * u - sy * v, deep = sy * u + cy * v;
      return [width / 2 + scale * right, height / 2 - scale * (cp * w + sp * deep), cp * deep - sp * w];
    }
    const place = (frame, i) => project(frame.where[i * d], d > 1 ? frame.where[i * d + 1] : 0, d > 2 ? frame.where[i * d + 2] : 0);
    const agentColour = (i) => theme.agents[i % theme.agents.length];
    const ownerColour = (owners, out) => (scene.few && owners.length === 1 ? agentColour(owners[0]) : out ? theme.bar : scene.few ? theme.axis : theme.area);

    function hatch(colour) {
      dots = dots || new Map();
      if (!dots.has(colour)) {
        const tile = document.createElement("canvas"), side = Math.round(8 * ratio);
        tile.width = tile.height = side;
        const ink = tile.getContext("2d");
        ink.strokeStyle = colour; ink.lineWidth = 1.1 * ratio; ink.globalAlpha = 0.85;
        ink.beginPath();
        for (const s of [-side, 0, side]) { ink.moveTo(s - 1, side + 1); ink.lineTo(s + side + 1, -1); }
        ink.stroke();
        const pattern = pen.createPattern(tile, "repeat");
        pattern.setTransform(new DOMMatrix().scale(1 / ratio));
        dots.set(colour, pattern);
      }
      return dots.get(colour);
    }

    // A ball that moves by a schedule is told at some samples, and moves evenly between them.
    function ballNow(frame, ball) {
      if (!ball.track) return ball;
      const { at, center: centers, radius } = ball.track;
      let a = 0;
      while (a < at.length - 1 && at[a + 1] <= frame.moment) a += 1;
      const b = Math.min(a + 1, at.length - 1), share = b > a ? Math.min(1, (frame.moment - at[a]) / (at[b] - at[a])) : 0;
      const mix = (u, v) => (1 - share) * u + share * v;
      return { ...ball, center: centers[a].map((value, k) => mix(value, centers[b][k])), radius: mix(radius[a], radius[b]) };
    }

    function ballCenter(frame, ball) {
      const at = [0, 0, 0];
      for (let k = 0; k < d; k += 1) at[k] = ball.center[k] + (ball.around < 0 ? 0 : frame.where[ball.around * d + k]);
      return at;
    }

    function drawBall(frame, told, loud) {
      const ball = ballNow(frame, told), at = ballCenter(frame, ball), [px, py] = project(...at), r = scale * ball.radius, colour = ownerColour(ball.owners, ball.out);
      if (!scene.few && ball.around >= 0 && !loud) return;
      pen.beginPath(); pen.arc(px, py, r, 0, 2 * Math.PI);
      pen.fillStyle = colour;
      pen.globalAlpha = ball.out ? 0.16 : ball.around >= 0 ? 0.03 : 0.1;
      pen.fill();
      if (ball.out) { pen.globalAlpha = 0.9; pen.fillStyle = hatch(colour); pen.fill(); }
      pen.globalAlpha = ball.around >= 0 && !loud ? 0.5 : 0.95;
      pen.strokeStyle = colour; pen.lineWidth = loud ? 2.2 : ball.around >= 0 ? 1 : 1.5;
      pen.setLineDash(ball.around >= 0 ? [5, 4] : []);
      pen.stroke(); pen.setLineDash([]);
      if (scene.space) {
        pen.globalAlpha *= 0.5; pen.lineWidth = 0.8;
        for (const ring of [[0, 1], [0, 2], [1, 2]]) {
          pen.beginPath();
          for (let k = 0; k <= 40; k += 1) {
            const p = [...at];
            p[ring[0]] += ball.radius * Math.cos(k * Math.PI / 20); p[ring[1]] += ball.radius * Math.sin(k * Math.PI / 20);
            const [qx, qy] = project(...p);
            if (k) pen.lineTo(qx, qy); else pen.moveTo(qx, qy);
          }
          pen.stroke();
        }
      }
      pen.globalAlpha = 1;
    }

    // The goals of a crowd: overlaps are tinted once, and of very many no edges are drawn.
    function drawUnion(frame) {
      const goals = scene.balls.filter((ball) => !ball.out && ball.around < 0).map((ball) => ballNow(frame, ball));
      pen.beginPath();
      for (const ball of goals) {
        const [px, py] = project(...ballCenter(frame, ball)), r = scale * ball.radius;
        pen.moveTo(px + r, py); pen.arc(px, py, r, 0, 2 * Math.PI);
      }
      pen.fillStyle = pen.strokeStyle = theme.area; pen.lineWidth = 0.8;
      pen.globalAlpha = 0.12; pen.fill();
      if (goals.length <= 200) { pen.globalAlpha = 0.6; pen.stroke(); }
      pen.globalAlpha = 1;
    }

    function drawWall(wall) {
      const colour = ownerColour(wall.owners, false);
      pen.strokeStyle = colour; pen.lineWidth = 1.4; pen.fillStyle = colour;
      pen.beginPath();
      wall.corners.forEach((corner, k) => { const [px, py] = project(corner[0], corner[1] || 0, corner[2] || 0); if (k) pen.lineTo(px, py); else pen.moveTo(px, py); });
      if (scene.space) { pen.closePath(); pen.globalAlpha = 0.06; pen.fill(); }
      pen.globalAlpha = 0.9; pen.stroke();
      if (!scene.space && wall.corners.length === 2) {
        const [a, b] = wall.corners.map((corner) => project(corner[0], corner[1], 0)), far = Math.hypot(b[0] - a[0], b[1] - a[1]);
        const n = [wall.normal[0], -wall.normal[1]];
        pen.lineWidth = 1; pen.beginPath();
        for (let s = 6; s < far; s += 14) {
          const px = a[0] + (b[0] - a[0]) * s / far, py = a[1] + (b[1] - a[1]) * s / far;
          pen.moveTo(px, py); pen.lineTo(px + 6 * n[0], py + 6 * n[1]);
        }
        pen.stroke();
      }
      pen.globalAlpha = 1;
    }

    function drawOutline(frame, outline) {
      let k = 0;
      while (k < outline.at.length - 1 && outline.at[k + 1] <= frame.sample) k += 1;
      pen.strokeStyle = ownerColour(outline.owners, false); pen.lineWidth = 1.3; pen.globalAlpha = 0.85;
      pen.beginPath();
      for (const line of outline.lines[k]) {
        for (let j = 0; j < line.length; j += 2) {
          const [px, py] = project(line[j], line[j + 1], 0);
          if (j) pen.lineTo(px, py); else pen.moveTo(px, py);
        }
      }
      pen.stroke(); pen.globalAlpha = 1;
    }

    // What stands in the way: solid, as nothing else is. In space a box is drawn side by side, the farthest first.
    function drawObstacle(obstacle) {
      pen.fillStyle = theme.solid; pen.strokeStyle = theme.edge; pen.lineWidth = 1.2;
      const close = (points) => { pen.beginPath(); points.forEach(([px, py], k) => (k ? pen.lineTo(px, py) : pen.moveTo(px, py))); pen.closePath(); pen.fill(); pen.stroke(); };
      if (obstacle.kind === "disc") {
        const [px, py] = project(obstacle.center[0], obstacle.center[1], obstacle.center[2] || 0);
        pen.beginPath(); pen.arc(px, py, scale * obstacle.radius, 0, 2 * Math.PI); pen.fill(); pen.stroke();
        return;
      }
      if (obstacle.kind === "polygon") { close(obstacle.vertices.map(([x, y]) => project(x, y, 0))); return; }
      const ends = [obstacle.low, obstacle.high], at = (k) => project(ends[k >> 2 & 1][0], ends[k >> 1 & 1][1], scene.space ? ends[k & 1][2] : 0);
      if (!scene.space) { close([0, 4, 6, 2].map(at)); return; }
      const sides = [[0, 1, 3, 2], [4, 5, 7, 6], [0, 1, 5, 4], [2, 3, 7, 6], [0, 2, 6, 4], [1, 3, 7, 5]].map((side) => side.map(at));
      const depth = (side) => side.reduce((sum, corner) => sum + corner[2], 0);
      sides.sort((one, other) => depth(other) - depth(one)).forEach(close);
    }

    // The bodies of robots: their true size, and a stroke to where they look.
    function drawBodies(frame) {
      const { radius, offset } = scene.bodies, turns = frame.heading !== null;
      for (let i = 0; i < scene.count; i += 1) {
        const ahead = turns ? [Math.cos(frame.heading[i]), Math.sin(frame.heading[i])] : [0, 0];
        const x = frame.where[i * d] - offset[i] * ahead[0], y = (d > 1 ? frame.where[i * d + 1] : 0) - offset[i] * ahead[1];
        const [px, py] = project(x, y, d > 2 ? frame.where[i * d + 2] : 0), r = scale * radius[i];
        pen.fillStyle = scene.few ? agentColour(i) : shadeOf(scene, frame.margins[i]); pen.strokeStyle = theme.edge;
        pen.globalAlpha = scene.few ? 0.6 : 0.95; pen.lineWidth = 1;
        pen.beginPath(); pen.arc(px, py, r, 0, 2 * Math.PI); pen.fill(); pen.globalAlpha = 1; pen.stroke();
        if (turns && offset[i] > 0) { pen.lineWidth = 1.6; pen.beginPath(); pen.moveTo(px, py); pen.lineTo(px + r * ahead[0], py - r * ahead[1]); pen.stroke(); }
      }
    }

    function drawGrid() {
      const lo = scene.space ? low : [center[0] - width / 2 / scale, center[1] - height / 2 / scale];
      const hi = scene.space ? high : [center[0] + width / 2 / scale, center[1] + height / 2 / scale];
      const raw = 80 / scale, power = 10 ** Math.floor(Math.log10(raw)), unit = [1, 2, 5, 10].find((m) => m * power >= raw) * power;
      pen.strokeStyle = theme.grid; pen.fillStyle = theme.axis; pen.lineWidth = 1; pen.font = "11px system-ui, sans-serif";
      for (let axis = 0; axis < Math.min(2, Math.max(d, scene.space ? 2 : d)); axis += 1) {
        for (let k = Math.ceil(lo[axis] / unit); k * unit <= hi[axis]; k += 1) {
          const value = k * unit, from = axis ? [lo[0], value] : [value, lo[1] || 0], to = axis ? [hi[0], value] : [value, hi[1] || 0];
          const floor = scene.space ? low[2] : 0, a = project(from[0], from[1], floor), b = project(to[0], to[1], floor);
          pen.beginPath(); pen.moveTo(a[0], a[1]); pen.lineTo(b[0], b[1]); pen.stroke();
          if (!scene.space) {
            const text = String(Number(value.toPrecision(6))).replace("-", "−");
            if (axis) pen.fillText(text, 4, a[1] - 3); else pen.fillText(text, a[0] + 3, height - 5);
          }
        }
      }
    }

    function drawAxes() {
      pen.fillStyle = theme.axis; pen.font = "12px system-ui, sans-serif"; pen.strokeStyle = theme.axis; pen.lineWidth = 1;
      const origin = [low[0], low[1], low[2]];
      for (let axis = 0; axis < 3; axis += 1) {
        const end = [...origin];
        end[axis] = high[axis];
        const a = project(...origin), b = project(...end);
        pen.beginPath(); pen.moveTo(a[0], a[1]); pen.lineTo(b[0], b[1]); pen.stroke();
        const far = Math.hypot(b[0] - a[0], b[1] - a[1]) || 1, unit = scene.unit ? ` ${scene.unit}` : "";
        pen.textAlign = "center";
        pen.fillText(`${"xyz"[axis]} = ${Number(end[axis].toPrecision(2))}${unit}`.replace("-", "−"), b[0] + 16 * (b[0] - a[0]) / far, b[1] + 16 * (b[1] - a[1]) / far);
        pen.textAlign = "left";
      }
    }

    function drawTrails(frame) {
      const size = scene.count * d, stride = Math.max(1, Math.ceil((frame.sample + 1) * scene.count / MOST_SEGMENTS));
      const one = (i) => {
        let first = true;
        for (let s = 0; s <= frame.sample; s += stride) {
          const o = s * size + i * d, [px, py] = project(scene.x[o], d > 1 ? scene.x[o + 1] : 0, d > 2 ? scene.x[o + 2] : 0);
          if (first) pen.moveTo(px, py); else pen.lineTo(px, py);
          first = false;
        }
        const [px, py] = place(frame, i);
        pen.lineTo(px, py);
      };
      pen.lineJoin = "round";
      if (scene.few) {
        pen.lineWidth = 1.8; pen.globalAlpha = 0.8;
        for (let i = 0; i < scene.count; i += 1) { pen.strokeStyle = agentColour(i); pen.beginPath(); one(i); pen.stroke(); }
      } else {
        pen.strokeStyle = theme.trail; pen.lineWidth = 1; pen.beginPath();
        for (let i = 0; i < scene.count; i += 1) one(i);
        pen.stroke();
      }
      pen.globalAlpha = 1;
    }

    function drawLinks(frame) {
      pen.strokeStyle = theme.link; pen.lineWidth = scene.few ? 1.1 : 0.7; pen.globalAlpha = 0.75;
      if (scene.few) pen.setLineDash([2, 3]);
      pen.beginPath();
      for (let k = 0; k < scene.links.length; k += 2) {
        const a = place(frame, scene.links[k]), b = place(frame, scene.links[k + 1]);
        pen.moveTo(a[0], a[1]); pen.lineTo(b[0], b[1]);
      }
      pen.stroke(); pen.setLineDash([]); pen.globalAlpha = 1;
    }

    function drawAgents(frame) {
      const radius = scene.bodies ? 2.5 : scene.count <= FEW ? 6 : scene.count < 60 ? 5 : scene.count < 300 ? 4 : 3, places = [], groups = new Map();
      for (let i = 0; i < scene.count; i += 1) {
        places.push(place(frame, i));
        const colour = scene.few ? agentColour(i) : shadeOf(scene, frame.margins[i]);
        if (!groups.has(colour)) groups.set(colour, []);
        groups.get(colour).push(i);
      }
      if (scene.space) {
        pen.strokeStyle = theme.axis; pen.globalAlpha = 0.5; pen.setLineDash([1, 3]); pen.lineWidth = 1; pen.beginPath();
        for (let i = 0; i < scene.count; i += 1) {
          const foot = project(frame.where[i * d], frame.where[i * d + 1], low[2]);
          pen.moveTo(places[i][0], places[i][1]); pen.lineTo(foot[0], foot[1]);
        }
        pen.stroke(); pen.setLineDash([]); pen.globalAlpha = 1;
      }
      pen.strokeStyle = theme.paper; pen.lineWidth = 1;
      for (const [colour, members] of groups) {
        pen.fillStyle = colour; pen.beginPath();
        for (const i of members) { pen.moveTo(places[i][0] + radius, places[i][1]); pen.arc(places[i][0], places[i][1], radius, 0, 2 * Math.PI); }
        pen.fill();
        pen.strokeStyle = scene.few ? theme.paper : theme.ink; pen.globalAlpha = scene.few ? 1 : 0.6; pen.lineWidth = scene.few ? 1.5 : 0.6; pen.stroke(); pen.globalAlpha = 1;
      }
      // A violated agent also has a ring, for those who cannot tell the colours.
      pen.strokeStyle = "#D55E00"; pen.lineWidth = 1.6; pen.beginPath();
      for (let i = 0; i < scene.count; i += 1) {
        if (scene.few && frame.margins[i] <= 0) { pen.moveTo(places[i][0] + radius + 3.5, places[i][1]); pen.arc(places[i][0], places[i][1], radius + 3.5, 0, 2 * Math.PI); }
      }
      pen.stroke();
      pen.font = "600 13px system-ui, sans-serif"; pen.lineJoin = "round";
      const taken = places.slice(0, scene.few ? scene.count : 0).map(([px, py]) => [px - 7, py - 7, px + 7, py + 7]);
      for (let i = 0; i < scene.count; i += 1) {
        if (!(show.names && scene.few) && i !== show.chosen) continue;
        const text = scene.ids[i].length > 16 ? `${scene.ids[i].slice(0, 15)}…` : scene.ids[i], wide = pen.measureText(text).width;
        const [px, py] = places[i], spots = [[9, -9], [-9 - wide, -9], [9, 19], [-9 - wide, 19], [-wide / 2, -13], [-wide / 2, 23]];
        const boxes = spots.map(([u, v]) => [px + u, py + v - 12, px + u + wide, py + v + 3]);
        const meets = boxes.map((a) => taken.filter((b) => a[0] < b[2] && b[0] < a[2] && a[1] < b[3] && b[1] < a[3]).length);
        const best = meets.indexOf(Math.min(...meets));
        taken.push(boxes[best]);
        pen.strokeStyle = theme.paper; pen.lineWidth = 4; pen.strokeText(text, px + spots[best][0], py + spots[best][1]);
        pen.fillStyle = scene.few ? agentColour(i) : theme.ink; pen.fillText(text, px + spots[best][0], py + spots[best][1]);
      }
      if (show.chosen >= 0) {
        const [px, py] = places[show.chosen];
        pen.strokeStyle = theme.ink; pen.lineWidth = 2; pen.beginPath(); pen.arc(px, py, radius + 7, 0, 2 * Math.PI); pen.stroke();
      }
    }

    function draw(frame) {
      last = frame;
      pen.setTransform(ratio, 0, 0, ratio, 0, 0);
      pen.fillStyle = theme.paper; pen.fillRect(0, 0, width, height);
      drawGrid();
      if (scene.space) drawAxes();
      (scene.obstacles || []).forEach(drawObstacle);
      if (show.regions) {
        scene.walls.forEach(drawWall);
        if (!scene.few && !scene.space) drawUnion(frame);
        const alone = (ball) => ball.out || scene.few || scene.space;
        for (const out of [false, true]) for (const ball of scene.balls) if (alone(ball) && ball.out === out && !ball.owners.includes(show.chosen)) drawBall(frame, ball, false);
        for (const outline of scene.outlines) drawOutline(frame, outline);
      }
      for (const ball of scene.balls) if (ball.owners.includes(show.chosen)) drawBall(frame, ball, true);
      if (show.trails) drawTrails(frame);
      if (show.links) drawLinks(frame);
      if (scene.bodies) drawBodies(frame);
      drawAgents(frame);
    }

    return {
      draw, fit, resize, show,
      where: (i) => (last ? place(last, i).slice(0, 2) : null),
      pick(px, py) {
        let best = -1, near = 14;
        for (let i = 0; last && i < scene.count; i += 1) { const [qx, qy] = place(last, i), far = Math.hypot(qx - px, qy - py); if (far < near) { near = far; best = i; } }
        return best;
      },
      pan(dx, dy) { if (scene.space) { yaw += dx * 0.008; pitch = Math.min(1.5, Math.max(-0.2, pitch + dy * 0.008)); } else { center[0] -= dx / scale; center[1] += dy / scale; } },
      zoom(factor, px = width / 2, py = height / 2) {
        const u = (px - width / 2) / scale, v = (py - height / 2) / scale;
        scale *= factor;
        if (!scene.space) { center[0] += u - u / factor; center[1] -= v - v / factor; }
      },
      theme(name) { theme = THEMES[name]; dots = null; },
    };
  }

  // ---- the margin over time: moment -> picture

  function createChart(canvas, scene) {
    const pen = canvas.getContext("2d");
    let theme = THEMES.light, width = 1, height = 1, ratio = 1;
    const finite = [...scene.margin].filter(Number.isFinite), end = Math.abs(finite[finite.length - 1] || 1) || 1;
    const bend = (v) => Math.asinh(v / (end / 2)), values = [...finite, 0, ...(scene.bounds || []).filter((b) => b !== null)].map(bend);
    const top = Math.max(...values) + 0.15, bottom = Math.min(...values) - 0.15, first = scene.steps[0], final = scene.steps[scene.samples - 1];
    const px = (step) => 46 + (width - 56) * (step - first) / ((final - first) || 1), py = (v) => 8 + (height - 28) * (top - bend(v)) / (top - bottom);
    const curve = (series, colour, dash) => {
      pen.strokeStyle = colour; pen.lineWidth = 1.8; pen.setLineDash(dash); pen.beginPath();
      let on = false;
      const stride = Math.max(1, Math.floor(scene.samples / 1500));
      for (let s = 0; s < scene.samples; s += s + stride < scene.samples || s === scene.samples - 1 ? stride : scene.samples - 1 - s) {
        if (!Number.isFinite(series[s])) { on = false; continue; }
        const x = px(scene.steps[s]), y = Math.min(Math.max(py(series[s]), 0), height);
        if (on) pen.lineTo(x, y); else pen.moveTo(x, y);
        on = true;
      }
      pen.stroke(); pen.setLineDash([]);
    };
    return {
      resize() { ratio = Math.max(1, window.devicePixelRatio || 1); width = canvas.clientWidth; height = canvas.clientHeight; canvas.width = Math.round(width * ratio); canvas.height = Math.round(height * ratio); },
      theme(name) { theme = THEMES[name]; },
      momentAt(x) { const step = first + (x - 46) / (width - 56) * (final - first); let s = 0; while (s < scene.samples - 1 && scene.steps[s + 1] <= step) s += 1; return s; },
      draw(frame) {
        pen.setTransform(ratio, 0, 0, ratio, 0, 0); pen.clearRect(0, 0, width, height);
        pen.font = "11px system-ui, sans-serif"; pen.textAlign = "right"; pen.fillStyle = theme.axis;
        const [lower, upper] = scene.bounds || [null, null];
        if (lower !== null && upper !== null) { pen.fillStyle = "#009E73"; pen.globalAlpha = 0.3; const y = py(upper); pen.fillRect(46, y - 1, width - 56, Math.max(2, py(lower) - y)); pen.globalAlpha = 1; }
        pen.strokeStyle = theme.grid; pen.lineWidth = 1; pen.fillStyle = theme.axis;
        const told = [0, ...[1, 0.1, 10, 100, 1000, 1e4, 1e5].flatMap((m) => { const v = m * 10 ** Math.round(Math.log10(end)); return [v, -v]; })];
        const drawnAt = [];
        for (const v of told) {
          const y = py(v);
          if (y < 6 || y > height - 22 || drawnAt.some((other) => Math.abs(other - y) < 14)) continue;
          drawnAt.push(y);
          pen.strokeStyle = v === 0 ? theme.ink : theme.grid; pen.beginPath(); pen.moveTo(46, y); pen.lineTo(width - 10, y); pen.stroke();
          pen.fillText(String(Number(v.toPrecision(1))).replace("-", "−"), 42, y + 4);
        }
        for (const [from, to, verdict] of scene.verdicts || []) { // a band: can the constraints all hold
          pen.fillStyle = VERDICTS[verdict]; pen.fillRect(px(from), height - 20, Math.max(1, px(to) - px(from)), 4); pen.fillStyle = theme.axis;
        }
        pen.textAlign = "center"; pen.fillText(scene.clock === "time" ? "time [s]" : "round", width / 2, height - 4);
        pen.textAlign = "left"; pen.fillText(String(Number(first.toPrecision(4))), 46, height - 4);
        pen.textAlign = "right"; pen.fillText(String(Number(final.toPrecision(4))), width - 10, height - 4);
        if (scene.since !== null) { pen.strokeStyle = "#CC79A7"; pen.setLineDash([2, 3]); pen.beginPath(); pen.moveTo(px(scene.since), 4); pen.lineTo(px(scene.since), height - 18); pen.stroke(); pen.setLineDash([]); }
        if (scene.bound) curve(scene.bound, "#D55E00", [2, 3]);
        curve(scene.margin, theme.area, []);
        const x = px(frame.step);
        pen.strokeStyle = theme.ink; pen.lineWidth = 1; pen.beginPath(); pen.moveTo(x, 4); pen.lineTo(x, height - 18); pen.stroke();
        if (Number.isFinite(frame.margin)) { pen.fillStyle = theme.ink; pen.beginPath(); pen.arc(x, py(frame.margin), 3.5, 0, 2 * Math.PI); pen.fill(); }
      },
    };
  }

  // ---- player

  const say = (value, digits = 3) => (Number.isFinite(value) ? (Math.abs(value) >= 1e4 ? value.toExponential(1) : String(Number(value.toPrecision(digits)))).replace("-", "−") : "none");

  function createPlayer(root, scene) {
    const part = (name) => root.querySelector(`[data-part="${name}"]`);
    const stage = part("stage"), slider = part("slider"), play = part("play"), tip = part("tip"), live = part("live");
    const view = createView(stage, scene), chart = createChart(part("chart"), scene);
    let moment = 0, playing = false, speed = 1, before = 0, fps = 0, dark = window.matchMedia("(prefers-color-scheme: dark)").matches;
    const seconds = Math.min(20, Math.max(6, scene.samples / 20));
    // Most happens at the beginning: moments are spread by the way travelled as much as by the clock.
    const spread = scene.spread;
    const momentOf = (share) => { const s = Math.min(Math.max(share, 0), 1) * (spread.length - 1), a = Math.floor(s), b = Math.min(a + 1, spread.length - 1); return spread[a] + (s - a) * (spread[b] - spread[a]); };
    const shareOf = (at) => { let a = 0; while (a < spread.length - 2 && spread[a + 1] <= at) a += 1; const gap = spread[a + 1] - spread[a]; return (a + (gap > 0 ? Math.min(1, (at - spread[a]) / gap) : 0)) / (spread.length - 1); };
    let share = 0;

    function table(frame) {
      const order = [...scene.ids.keys()], rows = part("rows");
      if (!scene.few) order.sort((a, b) => (Number.isFinite(frame.margins[a]) ? frame.margins[a] : Infinity) - (Number.isFinite(frame.margins[b]) ? frame.margins[b] : Infinity));
      const shown = order.slice(0, FEW);
      while (rows.children.length < shown.length) {
        const row = document.createElement("button"), dot = document.createElement("i"), name = document.createElement("b"), told = document.createElement("span");
        row.type = "button"; row.append(dot, name, told);
        row.addEventListener("click", () => choose(Number(row.dataset.agent)));
        rows.append(row);
      }
      shown.forEach((i, k) => {
        const row = rows.children[k], [dot, name, told] = row.children, margin = frame.margins[i];
        row.dataset.agent = String(i);
        row.setAttribute("aria-pressed", String(view.show.chosen === i));
        dot.style.background = scene.few ? THEMES[dark ? "dark" : "light"].agents[i % AGENTS.length] : shadeOf(scene, margin);
        name.textContent = scene.ids[i];
        told.textContent = Number.isFinite(margin) ? `${margin > 0 ? "✓" : "✗"} ${say(margin)}` : "no constraints";
        told.className = margin > 0 || !Number.isFinite(margin) ? "" : "bad";
      });
    }

    function paint() {
      const frame = frameAt(scene, moment);
      view.draw(frame); chart.draw(frame);
      part("step").textContent = scene.clock === "time" ? `t = ${frame.step.toFixed(1)} s` : `round ${Math.round(frame.step)}`;
      part("margin").textContent = say(frame.margin);
      part("margin").className = frame.margin > 0 ? "good" : "bad";
      part("state").textContent = !Number.isFinite(frame.margin) ? "" : frame.margin > 0 ? "every constraint holds now" : "not every constraint holds now";
      slider.value = String(Math.round(1000 * share));
      slider.setAttribute("aria-valuetext", part("step").textContent);
      table(frame);
      api.round = frame.step; api.margin = frame.margin; api.fps = fps;
      return frame;
    }
    function describe() {
      const frame = paint();
      const text = `${scene.name}: ${scene.count} agents, ${part("step").textContent}, margin ${say(frame.margin)}`;
      stage.setAttribute("aria-label", `Formation of ${text}`); live.textContent = text;
    }
    function tick(now) {
      if (!playing) return;
      const passed = Math.min(0.1, (now - before) / 1000);
      if (passed > 0) fps = fps ? 0.9 * fps + 0.1 / passed : 1 / passed;
      before = now; share = Math.min(1, share + speed * passed / seconds); moment = momentOf(share);
      if (share >= 1) { toggle(false); return; }
      paint(); requestAnimationFrame(tick);
    }
    function toggle(on = !playing) {
      playing = on;
      play.textContent = on ? "❚❚" : "▶"; play.setAttribute("aria-label", on ? "Pause" : "Play");
      if (on) { if (share >= 1) share = 0; before = performance.now(); requestAnimationFrame(tick); } else describe();
    }
    function seek(at) { moment = Math.min(Math.max(at, 0), scene.samples - 1); share = shareOf(moment); if (playing) paint(); else describe(); }
    function choose(i) { view.show.chosen = view.show.chosen === i ? -1 : i; describe(); }
    function paintTheme() {
      const name = dark ? "dark" : "light";
      document.documentElement.dataset.theme = name; view.theme(name); chart.theme(name);
      part("theme").setAttribute("aria-label", dark ? "Use light colours" : "Use dark colours");
      paint();
    }

    part("back").addEventListener("click", () => { toggle(false); seek(Math.ceil(moment) - 1); });
    part("next").addEventListener("click", () => { toggle(false); seek(Math.floor(moment) + 1); });
    play.addEventListener("click", () => toggle());
    slider.addEventListener("input", () => { if (playing) toggle(false); share = Number(slider.value) / 1000; moment = momentOf(share); describe(); });
    part("speed").addEventListener("change", (event) => { speed = Number(event.target.value); });
    part("theme").addEventListener("click", () => { dark = !dark; paintTheme(); });
    part("fit").addEventListener("click", () => { view.fit(); paint(); });
    for (const name of ["trails", "links", "regions", "names"]) {
      const box = part(name);
      box.checked = view.show[name];
      if (name === "names" && !scene.few) box.closest("label").hidden = true;
      box.addEventListener("change", () => { view.show[name] = box.checked; paint(); });
    }
    part("chart").addEventListener("pointerdown", (event) => { toggle(false); seek(chart.momentAt(event.offsetX)); });
    document.addEventListener("keydown", (event) => {
      if (event.target instanceof HTMLSelectElement || event.altKey || event.ctrlKey || event.metaKey) return;
      const inSlider = event.target === slider, onButton = event.target instanceof HTMLButtonElement || event.target.type === "checkbox";
      const keys = {
        " ": () => toggle(), k: () => toggle(), ArrowLeft: () => { toggle(false); seek(Math.ceil(moment) - 1); }, ArrowRight: () => { toggle(false); seek(Math.floor(moment) + 1); },
        Home: () => seek(0), End: () => { toggle(false); seek(scene.samples - 1); }, "+": () => { view.zoom(1.2); paint(); }, "-": () => { view.zoom(1 / 1.2); paint(); }, f: () => { view.fit(); paint(); },
        Escape: () => { view.show.chosen = -1; paint(); },
      };
      if (!keys[event.key] || (onButton && event.key === " ") || (inSlider && event.key !== " ")) return;
      event.preventDefault(); keys[event.key]();
    });

    const held = new Map();
    let moved = false, spreadBefore = 0;
    const gap = () => { const [a, b] = [...held.values()]; return Math.hypot(a[0] - b[0], a[1] - b[1]); };
    stage.addEventListener("pointerdown", (event) => { held.set(event.pointerId, [event.offsetX, event.offsetY]); moved = false; stage.setPointerCapture(event.pointerId); if (held.size === 2) spreadBefore = gap(); });
    stage.addEventListener("pointermove", (event) => {
      const from = held.get(event.pointerId), here = [event.offsetX, event.offsetY];
      if (from && held.size === 1) {
        if (Math.hypot(here[0] - from[0], here[1] - from[1]) > 3 || moved) { moved = true; view.pan(here[0] - from[0], here[1] - from[1]); held.set(event.pointerId, here); paint(); }
      } else if (from && held.size === 2) {
        held.set(event.pointerId, here); moved = true;
        const now = gap(); if (spreadBefore > 0) view.zoom(now / spreadBefore, ...here); spreadBefore = now; paint();
      } else {
        const i = view.pick(...here);
        tip.hidden = i < 0; stage.style.cursor = i < 0 ? "grab" : "pointer";
        if (i >= 0) {
          const frame = frameAt(scene, moment), d = scene.dimension, at = [...frame.where.subarray(i * d, i * d + d)].map((v) => say(v));
          tip.textContent = `${scene.ids[i]} at (${at.join(", ")})${scene.unit ? ` ${scene.unit}` : ""}, margin ${say(frame.margins[i])}`;
          tip.style.left = `${Math.min(here[0] + 14, stage.clientWidth - 230)}px`; tip.style.top = `${here[1] + 14}px`;
        }
      }
    });
    const release = (event) => { held.delete(event.pointerId); if (!moved && event.type === "pointerup") { const i = view.pick(event.offsetX, event.offsetY); if (i >= 0 || view.show.chosen >= 0) choose(i >= 0 ? i : view.show.chosen); } };
    stage.addEventListener("pointerup", release); stage.addEventListener("pointercancel", release);
    stage.addEventListener("pointerleave", () => { tip.hidden = true; });
    stage.addEventListener("wheel", (event) => { event.preventDefault(); view.zoom(Math.exp(-event.deltaY * 0.0015), event.offsetX, event.offsetY); paint(); }, { passive: false });
    stage.addEventListener("dblclick", () => { view.fit(); paint(); });
    new ResizeObserver(() => { view.resize(); chart.resize(); paint(); }).observe(stage);

    for (const value of SPEEDS) { const option = document.createElement("option"); option.value = String(value); option.textContent = `${value}×`; option.selected = value === 1; part("speed").append(option); }
    const api = { round: 0, margin: NaN, verdict: scene.verdict, fps: 0, agents: () => [...scene.ids], where: (id) => { const i = scene.ids.indexOf(id), box = stage.getBoundingClientRect(), at = i < 0 ? null : view.where(i); return at && [at[0] + box.left, at[1] + box.top]; }, seek, toggle };
    view.resize(); chart.resize(); paintTheme(); describe();
    if (!window.matchMedia("(prefers-reduced-motion: reduce)").matches) toggle(true);
    else { share = 1; seek(scene.samples - 1); }
    return api;
  }

  const scene = decode(JSON.parse(document.getElementById("run").textContent));
  window.consat = createPlayer(document.body, scene);
})();
