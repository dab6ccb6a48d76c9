// Volumes, points and parts in space: drawn by the processor, so that any browser shows them.
"use strict";
(() => {
const data = JSON.parse(document.getElementById("data").textContent);
const bytes = text => Uint8Array.from(atob(text), c => c.charCodeAt(0));
const floats = text => new Float32Array(bytes(text).buffer);
const dark = matchMedia("(prefers-color-scheme: dark)"), print = matchMedia("print");
let printing = false;
const theme = () => dark.matches && !print.matches && !printing
  ? {ink: "#e6edf3", soft: "#6e7781", paper: [23, 28, 35], part: [120, 160, 205]}
  : {ink: "#1b1f24", soft: "#8c959f", paper: [246, 248, 250], part: [140, 178, 220]};
const color = (name, share) => {
  const i = 3 * Math.max(0, Math.min(255, Math.round(share * 255))), p = data.colors[name];
  return [p[i], p[i + 1], p[i + 2]];
};

// What a scene has to say: its box, how it starts, and what it draws with the rotation r, pixels a millimetre and the middle.
const scenes = {
  cloud(scene) {
    const v = bytes(scene.voxels), n = scene.count, at = new Float32Array(3 * n);
    for (let i = 0; i < n; i++) {
      at[3 * i] = scene.first[0] + v[4 * i] * scene.pitch[0];
      at[3 * i + 1] = scene.first[1] + v[4 * i + 1] * scene.pitch[1];
      at[3 * i + 2] = scene.depths[v[4 * i + 2]];
    }
    const floor = document.getElementById("floor"), said = document.getElementById("floor-said");
    let light = new Uint8Array(0);
    const draw = (view, context) => {
      const {width: w, height: h} = view.canvas, least = floor ? Number(floor.value) : 1;
      // Values are square roots of the brightness.
      if (said) said.textContent = `${(100 * (least / 255) ** 2).toPrecision(2)} %`;
      if (light.length !== w * h) light = new Uint8Array(w * h);
      light.fill(0);
      const side = Math.max(1, Math.ceil(Math.max(scene.pitch[0], scene.pitch[1]) * view.scale)), half = (side - 1) / 2;
      for (let i = 0; i < n; i++) {
        const value = v[4 * i + 3];
        if (value < least) continue;
        const [x, y] = view.place(at[3 * i], at[3 * i + 1], at[3 * i + 2]);
        const left = Math.round(x - half), top = Math.round(y - half);
        for (let r = Math.max(top, 0); r < Math.min(top + side, h); r++)
          for (let c = Math.max(left, 0); c < Math.min(left + side, w); c++)
            if (light[r * w + c] < value) light[r * w + c] = value;
      }
      const image = context.createImageData(w, h), out = new Uint32Array(image.data.buffer), table = new Uint32Array(256);
      for (let k = 0; k < 256; k++) { const [r, g, b] = color("magma", k / 255); table[k] = (255 << 24 | b << 16 | g << 8 | r) >>> 0; }
      for (let i = 0; i < light.length; i++) out[i] = table[light[i]];
      context.putImageData(image, 0, 0);
    };
    if (floor) floor.addEventListener("input", () => view.draw());
    const view = {draw: () => {}};
    return {draw, yaw: 0.55, pitch: -0.45, upright: false, ink: "#e6edf3", soft: "#8c959f", made: v => { view.draw = () => v.draw(); }};
  },
  points(scene) {
    const at = floats(scene.places), [low, high] = [scene.box[0][2], scene.box[1][2]];
    const draw = (view, context) => {
      view.clear(context);
      const order = Array.from({length: scene.count}, (_, i) => [i, ...view.place(at[3 * i], at[3 * i + 1], at[3 * i + 2])]);
      order.sort((a, b) => b[3] - a[3]);
      const radius = (scene.count > 1000 ? 2.5 : 4.5) * view.unit;
      for (const [i, x, y] of order) {
        const [r, g, b] = color("viridis", high > low ? (at[3 * i + 2] - low) / (high - low) : 0.5);
        context.beginPath();
        context.arc(x, y, radius, 0, 7);
        context.fillStyle = `rgb(${r},${g},${b})`;
        context.fill();
        context.strokeStyle = theme().ink;
        context.lineWidth = 0.6;
        context.stroke();
      }
    };
    return {draw, yaw: 0.55, pitch: -0.45, upright: false};
  },
  mesh(scene) {
    const shares = new Uint16Array(bytes(scene.corners).buffer), facets = new Uint32Array(bytes(scene.facets).buffer);
    // A sheet has its own light and the colours of depths, from either side.
    const own = scene.light && bytes(scene.light), across = (a, b, c) => (own[a / 3] + own[b / 3] + own[c / 3]) / 765;
    const n = shares.length / 3, [low, high] = scene.box, at = new Float32Array(3 * n), on = new Float32Array(3 * n);
    for (let i = 0; i < 3 * n; i++) at[i] = low[i % 3] + shares[i] / 65535 * (high[i % 3] - low[i % 3]);
    const draw = (view, context) => {
      const {width: w, height: h} = view.canvas, {paper, part: stone} = theme();
      const image = context.createImageData(w, h), out = new Uint32Array(image.data.buffer), deep = new Float32Array(w * h).fill(Infinity);
      out.fill((255 << 24 | paper[2] << 16 | paper[1] << 8 | paper[0]) >>> 0);
      for (let i = 0; i < n; i++) on.set(view.place(at[3 * i], at[3 * i + 1], at[3 * i + 2]), 3 * i);
      for (let f = 0; f < facets.length; f += 3) {
        const [a, b, c] = [3 * facets[f], 3 * facets[f + 1], 3 * facets[f + 2]];
        const [ax, ay, az] = [on[a], on[a + 1], on[a + 2]], [bx, by, bz] = [on[b] - ax, on[b + 1] - ay, on[b + 2] - az];
        const [cx, cy, cz] = [on[c] - ax, on[c + 1] - ay, on[c + 2] - az], area = bx * cy - by * cx;
        if (area === 0) continue;
        let [nx, ny, nz] = [by * cz - bz * cy, bz * cx - bx * cz, area];
        const size = Math.hypot(nx, ny, nz) * (nz > 0 ? -1 : 1);
        const lit = 0.3 + 0.7 * Math.max(0, (nx * -0.45 + ny * -0.6 + nz * -0.66) / size);
        const part = own ? color("viridis", (shares[a + 2] + shares[b + 2] + shares[c + 2]) / 196605) : stone;
        const light = own ? 0.2 + 0.8 * Math.sqrt(across(a, b, c)) : lit;
        const shade = (255 << 24 | light * part[2] << 16 | light * part[1] << 8 | light * part[0]) >>> 0;
        const top = Math.max(0, Math.ceil(ay + Math.min(0, by, cy) - 0.01)), bottom = Math.min(h - 1, Math.floor(ay + Math.max(0, by, cy) + 0.01));
        const left = Math.max(0, Math.ceil(ax + Math.min(0, bx, cx) - 0.01)), right = Math.min(w - 1, Math.floor(ax + Math.max(0, bx, cx) + 0.01));
        for (let y = top; y <= bottom; y++)
          for (let x = left; x <= right; x++) {
            const u = ((x - ax) * cy - (y - ay) * cx) / area, v = (bx * (y - ay) - by * (x - ax)) / area;
            if (u < -1e-3 || v < -1e-3 || u + v > 1.001) continue;
            const z = az + u * bz + v * cz;
            if (z < deep[y * w + x]) { deep[y * w + x] = z; out[y * w + x] = shade; }
          }
      }
      context.putImageData(image, 0, 0);
    };
    return own ? {draw, yaw: 0.55, pitch: -0.45, upright: false} : {draw, yaw: 0.5, pitch: Math.PI / 2 + 0.75, upright: true, bare: true};
  },
};

class View {
  constructor(canvas, scene) {
    this.canvas = canvas;
    this.scene = scene;
    this.kind = scenes[scene.kind](scene);
    if (this.kind.made) this.kind.made(this);
    const [low, high] = scene.box;
    this.middle = low.map((v, i) => (v + high[i]) / 2);
    this.reach = Math.hypot(...low.map((v, i) => high[i] - v)) / 2 || 1;
    this.back();
    this.listen();
    this.draw();
  }
  back() { this.yaw = this.kind.yaw; this.pitch = this.kind.pitch; this.zoom = 1; }
  turn(across, down) { this.yaw += across; this.pitch += down; this.later(); }
  later() {
    if (this.waits) return;
    this.waits = true;
    requestAnimationFrame(() => { this.waits = false; this.draw(); });
  }
  // From mm to pixels and how far away: x right, y down, z away; about the axis that is upright, then toward the eye.
  place(x, y, z) {
    const {cy, sy, cp, sp} = this;
    x -= this.middle[0]; y -= this.middle[1]; z -= this.middle[2];
    let a, b, c;
    if (this.kind.upright) { a = x * cy - y * sy; b = x * sy + y * cy; c = z; }
    else { a = x * cy + z * sy; b = y; c = z * cy - x * sy; }
    const down = b * cp - c * sp, away = b * sp + c * cp;
    return [this.canvas.width / 2 + this.scale * a, this.canvas.height / 2 + this.scale * down, this.scale * away];
  }
  clear(context) {
    context.fillStyle = `rgb(${theme().paper})`;
    context.fillRect(0, 0, this.canvas.width, this.canvas.height);
  }
  // As many pixels as the screen has there; narrow screens get a higher picture. All of it is drawn anew.
  fit() {
    const wide = this.canvas.clientWidth || 880, dense = Math.min(devicePixelRatio || 1, 2, 1400 / wide);
    this.unit = dense;
    const size = [Math.round(wide * dense), Math.round(wide * dense * (wide < 560 ? 0.9 : 0.62))];
    if (this.canvas.width !== size[0] || this.canvas.height !== size[1]) [this.canvas.width, this.canvas.height] = size;
  }
  draw() {
    this.fit();
    const context = this.canvas.getContext("2d");
    [this.cy, this.sy, this.cp, this.sp] = [Math.cos(this.yaw), Math.sin(this.yaw), Math.cos(this.pitch), Math.sin(this.pitch)];
    this.scale = this.zoom * 0.46 * Math.min(this.canvas.height * 1.25, this.canvas.width) / this.reach;
    this.kind.draw(this, context);
    this.frame(context);
    this.canvas.dataset.drawn = "yes";
  }
  frame(context) {
    const box = this.scene.box, corner = k => this.place(box[k & 1][0], box[k >> 1 & 1][1], box[k >> 2 & 1][2]);
    context.lineWidth = 1;
    context.strokeStyle = this.kind.soft || theme().soft;
    if (!this.kind.bare) for (let k = 0; k < 8; k++)
      for (const bit of [1, 2, 4]) if (!(k & bit)) {
        const [from, to] = [corner(k), corner(k | bit)];
        context.beginPath(); context.moveTo(from[0], from[1]); context.lineTo(to[0], to[1]); context.stroke();
      }
    context.fillStyle = this.kind.ink || theme().ink;
    const u = this.unit;
    context.font = `${13 * u}px system-ui, sans-serif`;
    context.textBaseline = "top";
    const ends = i => `${"xyz"[i]} ${+box[0][i].toFixed(2)} to ${+box[1][i].toFixed(2)} mm`;
    [0, 1, 2].forEach(i => context.fillText(ends(i), 8 * u, (8 + i * 17) * u));
    // Which way x, y and z go.
    const origin = this.place(...this.middle), [x0, y0] = [44 * u, this.canvas.height - 44 * u];
    ["x", "y", "z"].forEach((name, i) => {
      const tip = this.middle.slice();
      tip[i] += 1;
      const to = this.place(...tip), size = 30 * u / this.scale, [dx, dy] = [(to[0] - origin[0]) * size, (to[1] - origin[1]) * size];
      context.beginPath(); context.moveTo(x0, y0); context.lineTo(x0 + dx, y0 + dy); context.stroke();
      context.fillText(name, x0 + dx * 1.25 - 3 * u, y0 + dy * 1.25 - 7 * u);
    });
  }
  listen() {
    const canvas = this.canvas, held = new Map();
    let apart = 0;
    const gap = () => { const [a, b] = [...held.values()]; return Math.hypot(a[0] - b[0], a[1] - b[1]); };
    canvas.addEventListener("pointerdown", e => {
      canvas.setPointerCapture(e.pointerId);
      held.set(e.pointerId, [e.clientX, e.clientY]);
      if (held.size === 2) apart = gap();
    });
    canvas.addEventListener("pointermove", e => {
      const last = held.get(e.pointerId);
      if (!last) return;
      held.set(e.pointerId, [e.clientX, e.clientY]);
      if (held.size === 2) { const now = gap(); this.grow(now / (apart || now)); apart = now; return; }
      this.turn(0.008 * (e.clientX - last[0]) * (this.kind.upright ? -1 : 1), -0.008 * (e.clientY - last[1]));
    });
    for (const name of ["pointerup", "pointercancel"]) canvas.addEventListener(name, e => held.delete(e.pointerId));
    canvas.addEventListener("keydown", e => {
      const step = 0.12, moves = {ArrowLeft: [-step, 0], ArrowRight: [step, 0], ArrowUp: [0, -step], ArrowDown: [0, step]};
      if (moves[e.key]) this.turn(...moves[e.key]);
      else if (e.key === "+" || e.key === "=") this.grow(1.15);
      else if (e.key === "-") this.grow(1 / 1.15);
      else if (e.key === "0") { this.back(); this.later(); }
      else return;
      e.preventDefault();
    });
    // A page that scrolls is not to zoom: the wheel belongs to the view that has the focus.
    canvas.addEventListener("wheel", e => {
      if (document.activeElement !== canvas) return;
      e.preventDefault();
      this.grow(Math.exp(-0.0015 * e.deltaY));
    }, {passive: false});
  }
  grow(by) { this.zoom = Math.max(0.3, Math.min(12, this.zoom * by)); this.later(); }
}

const all = [...document.querySelectorAll("canvas[data-view]")].map(c => new View(c, data.views[c.dataset.view]));
const again = () => all.forEach(view => view.draw());
dark.addEventListener("change", again);
print.addEventListener("change", again);
addEventListener("beforeprint", () => { printing = true; again(); });
addEventListener("afterprint", () => { printing = false; again(); });
addEventListener("resize", () => all.forEach(view => view.later()));
})();
