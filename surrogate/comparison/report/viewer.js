"use strict";
// Plays two superposed trajectories on a plain 2-D canvas: no library, no WebGL, no network.
(() => {
  const RADIUS = { H: 0.032, C: 0.05, N: 0.05, O: 0.05, F: 0.05, P: 0.062, S: 0.062, CL: 0.062, BR: 0.068, I: 0.074 };
  const NOT_FINITE = -32768;
  const style = (name) => getComputedStyle(document.documentElement).getPropertyValue(name).trim();

  function decode(text, nFrames, nAtoms) {
    const bytes = Uint8Array.from(atob(text), (c) => c.charCodeAt(0));
    const view = new DataView(bytes.buffer);
    const out = new Int16Array(nFrames * nAtoms * 3);
    for (let i = 0; i < out.length; i++) out[i] = view.getInt16(2 * i, true);
    return out;
  }

  function faultNames(flags, faults) {
    return Object.entries(faults).filter(([bit]) => flags & Number(bit)).map(([, name]) => name);
  }

  function duration(ps) {
    if (ps >= 1e6) return `${+(ps / 1e6).toPrecision(5)} µs`;
    if (ps >= 1e3) return `${+(ps / 1e3).toPrecision(5)} ns`;
    return ps >= 1 ? `${+ps.toPrecision(5)} ps` : `${+(ps * 1e3).toPrecision(4)} fs`;
  }

  function start(root) {
    const data = JSON.parse(root.querySelector("script[type='application/json']").textContent);
    const nAtoms = data.elements.length;
    const clips = data.clips.map((clip) => ({
      ...clip,
      frames: ["reference", "candidate"].map((who) => decode(clip[who], clip.time.length, nAtoms)),
    }));
    const canvas = root.querySelector("canvas");
    const context = canvas.getContext("2d");
    const find = (name) => root.querySelector(`[data-viewer='${name}']`);
    const play = find("play"), slider = find("frame"), label = find("time"), fault = find("fault");
    const clipChoice = find("clip"), speed = find("speed"), layout = find("layout");
    const shown = [find("reference"), find("candidate")], hydrogens = find("hydrogens");
    let clip = clips[0], frame = 0, timer = null, zoom = 1;
    let rotation = [1, 0, 0, 0, 1, 0, 0, 0, 1];

    // How far the molecules reach from the middle, and how high, in all but the farthest frames.
    const farthest = (measure) => {
      const found = [];
      for (const { frames } of clips) for (const source of frames) {
        for (let i = 0; i < source.length; i += 3 * nAtoms) {
          if (source[i] === NOT_FINITE) continue;
          let most = 0;
          for (let k = i; k < i + 3 * nAtoms; k += 3) most = Math.max(most, measure(source[k], source[k + 1], source[k + 2]));
          found.push(most * data.scale);
        }
      }
      found.sort((p, q) => p - q);
      return Math.max(0.1, found[Math.floor(0.95 * (found.length - 1))] || 0);
    };
    const extent = farthest((x, y, z) => Math.hypot(x, y, z));
    const reach = Math.max(farthest((x, y) => Math.abs(y)), 0.6 * extent);

    // Turn by angles about the screen's x and y axes, on the left of what there is.
    function turn(aboutX, aboutY) {
      const [cx, sx, cy, sy] = [Math.cos(aboutX), Math.sin(aboutX), Math.cos(aboutY), Math.sin(aboutY)];
      const step = [cy, 0, sy, sx * sy, cx, -sx * cy, -cx * sy, sx, cx * cy];
      const out = new Array(9);
      for (let i = 0; i < 3; i++) for (let j = 0; j < 3; j++) {
        out[3 * i + j] = step[3 * i] * rotation[j] + step[3 * i + 1] * rotation[3 + j] + step[3 * i + 2] * rotation[6 + j];
      }
      rotation = out;
    }

    function place(who, centreX, centreY, pixels) {
      const source = clip.frames[who], offset = frame * nAtoms * 3;
      if (source[offset] === NOT_FINITE) return null;
      const out = new Array(nAtoms);
      for (let a = 0; a < nAtoms; a++) {
        const [x, y, z] = [0, 1, 2].map((k) => source[offset + 3 * a + k] * data.scale);
        const depth = rotation[6] * x + rotation[7] * y + rotation[8] * z;
        const near = 1 / (1 - depth / (8 * extent));
        out[a] = {
          x: centreX + pixels * near * (rotation[0] * x + rotation[1] * y + rotation[2] * z),
          y: centreY - pixels * near * (rotation[3] * x + rotation[4] * y + rotation[5] * z),
          z: depth, near,
        };
      }
      return out;
    }

    function collect(who, colour, centreX, centreY, pixels, shapes) {
      const atoms = place(who, centreX, centreY, pixels);
      if (!atoms) return false;
      const hide = (a) => data.elements[a] === "H" && !hydrogens.checked;
      for (let b = 0; b < data.bonds.length; b += 2) {
        const [i, j] = [data.bonds[b], data.bonds[b + 1]];
        if (hide(i) || hide(j)) continue;
        const light = data.elements[i] === "H" || data.elements[j] === "H";
        shapes.push({ z: (atoms[i].z + atoms[j].z) / 2, from: atoms[i], to: atoms[j], colour, width: pixels * (light ? 0.018 : 0.028) });
      }
      for (let a = 0; a < nAtoms; a++) {
        if (hide(a)) continue;
        const element = data.elements[a].toUpperCase();
        const radius = pixels * (RADIUS[element] || 0.06) * atoms[a].near;
        // Elements are told apart by their letter, so that colour is left to say whose atom it is.
        const letter = element === "C" || element === "H" ? "" : data.elements[a];
        shapes.push({ z: atoms[a].z + 0.005, at: atoms[a], radius, colour, letter });
      }
      return true;
    }

    function draw() {
      const ratio = window.devicePixelRatio || 1;
      const [width, height] = [canvas.clientWidth, canvas.clientHeight];
      if (!width || !height) return;
      if (canvas.width !== Math.round(width * ratio) || canvas.height !== Math.round(height * ratio)) {
        canvas.width = Math.round(width * ratio);
        canvas.height = Math.round(height * ratio);
      }
      context.setTransform(ratio, 0, 0, ratio, 0, 0);
      context.clearRect(0, 0, width, height);
      const apart = layout.value === "beside";
      const across = apart ? width / 2 : width;
      const pixels = 0.42 * zoom * Math.min(across / extent, height / reach);
      const shapes = [], lost = [];
      const colours = [style("--reference"), style("--candidate")];
      ["reference", "candidate"].forEach((name, who) => {
        if (!shown[who].checked) return;
        const centreX = apart ? across * (who + 0.5) : width / 2;
        if (!collect(who, colours[who], centreX, height / 2, pixels, shapes)) lost.push(name);
      });
      shapes.sort((p, q) => p.z - q.z);
      const edge = style("--panel");
      for (const s of shapes) {
        // What lies behind fades towards the page.
        context.globalAlpha = Math.max(0.35, Math.min(1, 0.8 + (0.5 * s.z) / extent));
        if (s.from) {
          context.lineCap = "round";
          for (const [colour, more] of [[edge, 2.5], [s.colour, 0]]) {
            context.strokeStyle = colour;
            context.lineWidth = s.width + more;
            context.beginPath();
            context.moveTo(s.from.x, s.from.y);
            context.lineTo(s.to.x, s.to.y);
            context.stroke();
          }
        } else {
          context.fillStyle = s.colour;
          context.strokeStyle = edge;
          context.lineWidth = 1;
          context.beginPath();
          context.arc(s.at.x, s.at.y, s.radius, 0, 2 * Math.PI);
          context.fill();
          context.stroke();
          if (s.letter) {
            context.fillStyle = edge;
            context.beginPath();
            context.arc(s.at.x, s.at.y, 0.74 * s.radius, 0, 2 * Math.PI);
            context.fill();
            context.fillStyle = s.colour;
            context.font = `700 ${(1.15 * s.radius) / (0.7 + 0.3 * s.letter.length)}px system-ui, sans-serif`;
            context.textAlign = "center";
            context.textBaseline = "middle";
            context.fillText(s.letter, s.at.x, s.at.y);
          }
        }
      }
      context.globalAlpha = 1;
      label.textContent = duration(clip.time[frame]) + (clip.chunk && clip.chunk[frame] >= 0 ? `, chunk ${clip.chunk[frame]}` : "");
      const said = lost.map((name) => `${name}: cannot be drawn`);
      ["reference", "candidate"].forEach((name) => {
        const names = faultNames(clip[`${name}Flags`][frame], data.faults);
        if (names.length) said.push(`${name}: ${names.join(", ")}`);
      });
      fault.textContent = said.join(" · ");
      root.dataset.frame = String(frame);
    }

    function show(k) {
      frame = Math.max(0, Math.min(clip.time.length - 1, k));
      slider.value = String(frame);
      slider.setAttribute("aria-valuetext", duration(clip.time[frame]));
      draw();
    }

    function stop() {
      clearInterval(timer);
      timer = null;
      play.textContent = "▶ Play";
      play.setAttribute("aria-pressed", "false");
    }

    function run() {
      clearInterval(timer);
      timer = setInterval(() => show((frame + 1) % clip.time.length), 1000 / Number(speed.value));
      play.textContent = "❚❚ Pause";
      play.setAttribute("aria-pressed", "true");
    }

    clips.forEach((c, k) => clipChoice.add(new Option(c.name, String(k))));
    if (clips.length < 2) clipChoice.parentElement.hidden = true;
    if (!data.elements.includes("H")) hydrogens.parentElement.hidden = true;
    clipChoice.addEventListener("change", () => {
      clip = clips[Number(clipChoice.value)];
      slider.max = String(clip.time.length - 1);
      show(0);
    });
    slider.max = String(clip.time.length - 1);
    slider.addEventListener("input", () => { stop(); show(Number(slider.value)); });
    play.addEventListener("click", () => (timer === null ? run() : stop()));
    speed.addEventListener("change", () => timer !== null && run());
    for (const control of [layout, hydrogens, ...shown]) control.addEventListener("change", draw);
    find("reset").addEventListener("click", () => { rotation = [1, 0, 0, 0, 1, 0, 0, 0, 1]; zoom = 1; draw(); });

    const pointers = new Map();
    let spread = 0;
    canvas.addEventListener("pointerdown", (event) => {
      canvas.setPointerCapture(event.pointerId);
      pointers.set(event.pointerId, [event.clientX, event.clientY]);
      spread = 0;
    });
    canvas.addEventListener("pointermove", (event) => {
      const last = pointers.get(event.pointerId);
      if (!last) return;
      pointers.set(event.pointerId, [event.clientX, event.clientY]);
      if (pointers.size === 1) {
        turn((event.clientY - last[1]) * 0.01, (event.clientX - last[0]) * 0.01);
      } else {
        const [p, q] = [...pointers.values()];
        const now = Math.hypot(p[0] - q[0], p[1] - q[1]);
        if (spread > 0) zoom = Math.max(0.2, Math.min(8, (zoom * now) / spread));
        spread = now;
      }
      draw();
    });
    for (const name of ["pointerup", "pointercancel"]) {
      canvas.addEventListener(name, (event) => { pointers.delete(event.pointerId); spread = 0; });
    }
    // A plain wheel scrolls the page; with Ctrl (or once the picture has the focus) it zooms.
    canvas.addEventListener("wheel", (event) => {
      if (!event.ctrlKey && document.activeElement !== canvas) return;
      event.preventDefault();
      zoom = Math.max(0.2, Math.min(8, zoom * Math.exp(-event.deltaY * 0.002)));
      draw();
    }, { passive: false });
    canvas.addEventListener("keydown", (event) => {
      const turns = { ArrowLeft: [0, -0.1], ArrowRight: [0, 0.1], ArrowUp: [-0.1, 0], ArrowDown: [0.1, 0] };
      if (turns[event.key]) turn(...turns[event.key]);
      else if (event.key === "+" || event.key === "=") zoom = Math.min(8, zoom * 1.15);
      else if (event.key === "-") zoom = Math.max(0.2, zoom / 1.15);
      else if (event.key === " ") play.click();
      else return;
      event.preventDefault();
      draw();
    });

    new ResizeObserver(draw).observe(canvas);
    matchMedia("(prefers-color-scheme: dark)").addEventListener("change", draw);
    turn(0.25, -0.35);
    stop();
    show(0);
  }

  document.querySelectorAll(".viewer").forEach(start);
})();
