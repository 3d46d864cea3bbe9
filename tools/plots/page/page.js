"use strict";
/* The overview page: fields that are zoomed together, curves, the table of loads.  No libraries, nothing from a network.
   The data are in the page (element "data"); tiles that did not fit lie in a folder beside it and are loaded as scripts,
   since pages opened as files may load nothing else.  Tiles: see tools/plots/pyramid.py. */

const D = JSON.parse(document.getElementById("data").textContent);
const $ = id => document.getElementById(id);
const make = (tag, text, parent) => {
  const made = document.createElement(tag);
  if (text !== undefined) made.textContent = text;
  if (parent) parent.append(made);
  return made;
};
const clamp = (x, low, high) => Math.min(Math.max(x, low), high);

function lettered(parent, text, svg) { // text in which _x is a subscript
  for (const [n, part] of text.split(/_(.)/).entries()) {
    if (!svg) parent.append(n % 2 ? make("sub", part) : part);
    else if (part) for (const [dy, words] of n % 2 ? [[3, part], [-3, "\u200b"]] : [[0, part]]) node("tspan", n % 2 ? { dy, "font-size": 9 } : { dy }, parent, words);
  }
  return parent;
}

// ---- numbers as text ----------------------------------------------------------------------------------------------

const SUPERSCRIPTS = { "-": "⁻", 0: "⁰", 1: "¹", 2: "²", 3: "³", 4: "⁴", 5: "⁵", 6: "⁶", 7: "⁷", 8: "⁸", 9: "⁹" };
const power = n => "10" + [...String(n)].map(c => SUPERSCRIPTS[c]).join("");

function digits(x, count = 3) {
  if (!isFinite(x)) return "–";
  if (x === 0) return "0";
  const exponent = Math.floor(Math.log10(Math.abs(x)));
  if (exponent >= -3 && exponent < 6) return String(+x.toPrecision(Math.max(count, Math.min(exponent + 1, 6)))).replace("-", "−");
  const [mantissa, e] = x.toExponential(count - 1).split("e");
  return `${+mantissa}·${power(+e)}`.replace(/^-/, "−");
}

function rounded(x, step) { // as many digits as steps of that size warrant, five at most
  const count = step > 0 && x ? Math.floor(Math.log10(Math.abs(x))) - Math.floor(Math.log10(step)) + 1 : 5;
  return Math.abs(x) < step / 2 ? "0" : digits(+x.toPrecision(clamp(count, 1, 5)), 5);
}

function ticks(low, high, most) { // multiples of 1, 2 or 5 · 10ⁿ
  const raw = (high - low) / most, unit = 10 ** Math.floor(Math.log10(raw));
  const step = [1, 2, 5, 10].map(m => m * unit).find(s => s >= raw * (1 - 1e-9));
  const found = [];
  for (let n = Math.ceil(low / step - 1e-9); n * step <= high + step * 1e-9; n++) found.push(n * step);
  return { values: found, text: v => digits(Math.abs(v) < step * 1e-6 ? 0 : +v.toPrecision(12), Math.max(3, Math.ceil(Math.log10(Math.max(Math.abs(low), Math.abs(high)) / step)) + 1)) };
}

function sqrtTicks(low, high, most) { // 0 and 1, 2 or 5 · 10ⁿ, apart on a scale of square roots
  const least = (Math.sqrt(high) - Math.sqrt(low)) / most, values = [];
  let last = Infinity;
  for (let n = Math.floor(Math.log10(high)); n > Math.log10(high) - 8; n--) for (const m of [5, 2, 1]) {
    const v = m * 10 ** n;
    if (v <= high * (1 + 1e-9) && v >= low && last - Math.sqrt(v) >= least && Math.sqrt(v) - (low > 0 ? 0 : least) >= 0) { values.push(v); last = Math.sqrt(v); }
  }
  return { values: (low > 0 ? values : [...values, 0]).reverse(), text: v => digits(v) };
}

function logTicks(low, high, most) {
  const first = Math.ceil(Math.log10(low) - 1e-9), last = Math.floor(Math.log10(high) + 1e-9);
  const every = Math.max(1, Math.ceil((last - first + 1) / most));
  const values = [], decades = last - first >= 2 || high > 200 * low;
  const plain = decades ? low > 5e-4 && high < 2e3 : low > 1e-5 && high < 1e5;
  if (decades) for (let n = first; n <= last; n += every) values.push(10 ** n);
  else for (let n = first - 1; n <= last + 1; n++) for (const m of [1, 2, 5]) values.push(m * 10 ** n);
  return { values: values.filter(v => v >= low * (1 - 1e-9) && v <= high * (1 + 1e-9)),
           text: v => { const n = Math.log10(v); return !plain && Math.abs(n - Math.round(n)) < 1e-9 ? (v === 1 ? "1" : power(Math.round(n))) : plain ? String(+v.toPrecision(3)) : digits(v); } };
}

// ---- scales of the fields -----------------------------------------------------------------------------------------

const SCALES = {
  linear: { to: x => x, from: x => x },
  sqrt: { to: x => Math.sqrt(Math.max(x, 0)), from: x => x * x },
  log: { to: x => Math.log10(Math.max(x, 1e-300)), from: x => 10 ** x },
};
const MAPS = Object.fromEntries(Object.entries(D.maps).map(([name, hex]) => {
  const colours = new Uint32Array(256); // little-endian: alpha, blue, green, red
  for (let n = 0; n < 256; n++) {
    const c = parseInt(hex.slice(6 * n, 6 * n + 6), 16);
    colours[n] = (0xff000000 | (c & 0xff) << 16 | c & 0xff00 | c >> 16) >>> 0;
  }
  return [name, colours];
}));
const BLANK = 0xfff2f4f5; // where there is nothing to show: a light grey
const css = c => `rgb(${c & 255},${c >> 8 & 255},${c >> 16 & 255})`;

// ---- tiles --------------------------------------------------------------------------------------------------------

const [NX, NY] = D.shape, [LX, LY] = D.lengths, TILE = D.tile;
const MOST_POINTS = 4e7; // kept decoded
const tiles = new Map(); // key → {codes, w, h, low, high, used, pictures} or "asked for"
let folderMissing = false, waiting = 0, kept = 0;
const counted = (n, level) => Math.ceil(n / 2 ** level);

window.pgfmd_tile = async (key, low, high, text) => {
  const letters = atob(text), bytes = new Uint8Array(letters.length);
  for (let n = 0; n < letters.length; n++) bytes[n] = letters.charCodeAt(n);
  const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("deflate"));
  const codes = new Uint8Array(await new Response(stream).arrayBuffer());
  const [, level, i, j] = key.split("/");
  const w = Math.min(TILE, counted(NX, level) - i * TILE), h = codes.length / w;
  for (let x = 0; x < w; x++) { // undo the differences, along y and then along x; a Uint8Array takes them modulo 256
    const row = x * h;
    for (let y = 1; y < h; y++) codes[row + y] += codes[row + y - 1];
    if (x) for (let y = 0; y < h; y++) codes[row + y] += codes[row - h + y];
  }
  tiles.set(key, { codes, w, h, low, high, used: performance.now(), pictures: new Map() });
  kept += w * h;
  waiting--;
  repaint();
};

function drop() { // the tiles that were not used for longest, if there are too many
  if (kept <= MOST_POINTS) return;
  const old = [...tiles].filter(([, t]) => t.codes && t.used < now).sort((a, b) => a[1].used - b[1].used);
  for (const [key, tile] of old) {
    if (kept <= MOST_POINTS) return;
    kept -= tile.w * tile.h;
    tiles.delete(key);
  }
}

function tile(key) { // the tile if it is here; else it is asked for
  const found = tiles.get(key);
  if (found) return found.codes ? found : null;
  const inside = D.tiles[key];
  if (!inside && (!D.folder || folderMissing)) return null;
  tiles.set(key, "asked for");
  waiting++;
  if (inside) {
    window.pgfmd_tile(key, ...inside);
  } else {
    const script = make("script");
    script.src = `${D.folder}/${key.replaceAll("/", "-")}.js`;
    script.onload = () => script.remove();
    script.onerror = () => { script.remove(); folderMissing = true; waiting--; tiles.delete(key); repaint(); };
    document.head.append(script);
  }
  return null;
}

function picture(found, field, blank) { // the tile in colours, as a canvas, y upwards
  const [low, high] = range(field), id = `${field.map} ${low} ${high} ${blank}`;
  const made = found.pictures.get(id);
  if (made) return made;
  found.pictures.clear();
  const { codes, w, h } = found, map = MAPS[field.map], to = SCALES[field.scale].to;
  const a = to(low), b = to(high), table = new Uint32Array(256);
  table[0] = blank;
  for (let c = 1; c < 256; c++) {
    const value = found.low + (found.high - found.low) * (c - 1) / 254;
    table[c] = map[Math.round(255 * clamp(b > a ? (value - a) / (b - a) : 0.5, 0, 1))];
  }
  const canvas = make("canvas");
  canvas.width = w; canvas.height = h;
  const context = canvas.getContext("2d"), image = context.createImageData(w, h);
  const pixels = new Uint32Array(image.data.buffer);
  for (let x = 0; x < w; x++)
    for (let y = 0, at = x + w * (h - 1); y < h; y++, at -= w) pixels[at] = table[codes[x * h + y]];
  context.putImageData(image, 0, 0);
  found.pictures.set(id, canvas);
  return canvas;
}

// ---- the view, one for all panels ----------------------------------------------------------------------------------

const RX = LX / NX, RY = LY / NY, FINEST = Math.min(RX, RY); // spacings
const view = { load: D.shown.length ? D.shown[D.shown.length - 1] : 0, x: NX / 2, y: NY / 2, zoom: 0, whole: true, seen: false };
let hover = null, now = 0; // the point under the pointer, in points of the grid
const panels = [];

const imageOf = (field, load = view.load) => field.each ? `${field.key}.${load}` : field.key;
const isThere = field => D.images.includes(imageOf(field));
const step = () => [view.zoom * RX / FINEST, view.zoom * RY / FINEST]; // pixels per point

function range(field) {
  return view.seen && field.seen ? field.seen : field.range;
}

function valueAt(field, x, y) { // of the grid point in the finest tile that is here: [value, level, step of the values], or null
  const i = Math.floor(x), j = Math.floor(y);
  if (i < 0 || j < 0 || i >= NX || j >= NY) return null;
  for (let level = 0; level < D.levels; level++) {
    const a = i >> level, b = j >> level, ti = Math.floor(a / TILE), tj = Math.floor(b / TILE);
    const found = tiles.get(`${imageOf(field)}/${level}/${ti}/${tj}`);
    if (!found || !found.codes) continue;
    const code = found.codes[(a - ti * TILE) * found.h + b - tj * TILE];
    const unit = (found.high - found.low) / 254, scaled = found.low + unit * (code - 1), { from } = SCALES[field.scale];
    return [code ? from(scaled) : null, level, code ? (from(scaled + unit) - from(scaled - unit)) / 2 : 0];
  }
  return null;
}

class Panel {
  constructor(field) {
    this.field = field;
    const figure = make("figure", undefined, $("panels")), caption = make("figcaption", undefined, figure);
    make("b", field.title, caption);
    this.output = make("output", "", caption);
    this.canvas = make("canvas", undefined, figure);
    this.canvas.tabIndex = 0;
    this.canvas.setAttribute("role", "img");
    this.canvas.setAttribute("aria-label", `${field.title}; arrows move, + and − zoom`);
    listen(this);
  }

  measure() { // sizes in pixels of the screen; c: pixels of the screen per pixel of the layout
    const c = this.c = Math.max(1, window.devicePixelRatio || 1);
    const width = this.canvas.clientWidth;
    this.left = Math.round(52 * c);
    this.top = Math.round(6 * c);
    this.bottom = Math.round(78 * c);
    this.w = Math.round(width * c) - this.left - Math.round(12 * c);
    this.h = Math.round(this.w * clamp(LY / LX, 0.3, 1.25));
    const total = [this.left + this.w + Math.round(12 * c), this.top + this.h + this.bottom];
    if (this.canvas.width !== total[0] || this.canvas.height !== total[1]) {
      [this.canvas.width, this.canvas.height] = total;
      this.canvas.style.height = `${total[1] / c}px`;
    }
  }

  toGrid(px, py) { // from pixels of the canvas
    const [sx, sy] = step();
    return [view.x + (px - this.left - this.w / 2) / sx, view.y - (py - this.top - this.h / 2) / sy];
  }

  toScreen(x, y) {
    const [sx, sy] = step();
    return [this.left + this.w / 2 + (x - view.x) * sx, this.top + this.h / 2 - (y - view.y) * sy];
  }

  draw() {
    const g = this.canvas.getContext("2d"), { left, top, w, h, c, field } = this;
    g.setTransform(1, 0, 0, 1, 0, 0);
    g.fillStyle = "#fff";
    g.fillRect(0, 0, this.canvas.width, this.canvas.height);
    g.save();
    g.beginPath();
    g.rect(left, top, w, h);
    g.clip();
    g.fillStyle = "#fff";
    g.imageSmoothingEnabled = false;
    this.finest = Infinity;
    if (isThere(field)) {
      this.tiles(g, field, BLANK);
      const over = field.key === "height" && $("overlay").checked && D.fields.find(f => f.key === "pressure");
      if (over && over.blank && isThere(over)) this.tiles(g, over, 0);
    } else {
      g.fillStyle = css(BLANK);
      g.fillRect(left, top, w, h);
      g.fillStyle = "#5d6670";
      g.font = `${13 * c}px system-ui, sans-serif`;
      g.textAlign = "center";
      g.fillText("not kept for this load", left + w / 2, top + h / 2);
    }
    this.grid(g);
    if (hover) {
      const [px, py] = this.toScreen(Math.floor(hover[0]) + 0.5, Math.floor(hover[1]) + 0.5);
      g.strokeStyle = "rgba(0,0,0,.45)";
      g.lineWidth = c;
      g.beginPath();
      g.moveTo(px, top); g.lineTo(px, top + h); g.moveTo(left, py); g.lineTo(left + w, py);
      g.stroke();
    }
    g.restore();
    this.axes(g);
    this.bar(g);
    this.read();
  }

  tiles(g, field, blank) { // from coarse to fine, so that what is not here yet is shown coarsely
    const [sx, sy] = step(), wanted = clamp(Math.floor(-Math.log2(Math.max(sx, sy)) + 0.25), 0, D.levels - 1);
    const [x0, y1] = this.toGrid(this.left, this.top), [x1, y0] = this.toGrid(this.left + this.w, this.top + this.h);
    const drawn = (level, inside) => { // inside: only tiles that are in the page
      const size = TILE * 2 ** level, most = [NX, NY].map(n => Math.ceil(counted(n, level) / TILE) - 1);
      let all = true;
      for (let i = Math.max(0, Math.floor(x0 / size)); i <= Math.min(most[0], Math.floor(x1 / size)); i++)
        for (let j = Math.max(0, Math.floor(y0 / size)); j <= Math.min(most[1], Math.floor(y1 / size)); j++) {
          const key = `${imageOf(field)}/${level}/${i}/${j}`;
          const found = (!inside || D.tiles[key]) && tile(key);
          if (!found) { all = false; continue; }
          found.used = now;
          const [a, b] = this.toScreen(i * size, j * size);
          const [p, q] = this.toScreen(Math.min(i * size + found.w * 2 ** level, NX), Math.min(j * size + found.h * 2 ** level, NY));
          const [l, t] = [Math.round(a), Math.round(q)];
          const part = [(Math.min(i * size + found.w * 2 ** level, NX) - i * size) / 2 ** level, (Math.min(j * size + found.h * 2 ** level, NY) - j * size) / 2 ** level];
          g.drawImage(picture(found, field, blank), 0, found.h - part[1], part[0], part[1], l, t, Math.round(p) - l, Math.round(b) - t);
        }
      if (all) this.finest = Math.min(this.finest, level);
      return all;
    };
    if (blank) {
      for (let level = D.levels - 1; level > wanted; level--) drawn(level);
      if (!drawn(wanted) && (!D.folder || folderMissing)) for (let level = wanted - 1; level >= 0; level--) drawn(level, true);
    } else { // on top of another field: one level only, or points would be drawn twice
      for (let level = wanted; level < D.levels; level++) if (drawn(level)) break;
    }
  }

  grid(g) { // lines between points that are large; the edge of the cell
    const [sx, sy] = step(), { left, top, w, h, c } = this;
    const [a, b] = this.toScreen(0, 0), [p, q] = this.toScreen(NX, NY);
    g.lineWidth = 1;
    if (Math.min(sx, sy) > 14 * c) {
      g.strokeStyle = "rgba(128,128,128,.35)";
      g.beginPath();
      const [x0, y1] = this.toGrid(left, top).map(Math.floor), [x1, y0] = this.toGrid(left + w, top + h).map(Math.floor);
      for (let x = Math.max(0, x0); x <= Math.min(NX, x1 + 1); x++) { const s = Math.round(this.toScreen(x, 0)[0]) + 0.5; g.moveTo(s, Math.max(top, q)); g.lineTo(s, Math.min(top + h, b)); }
      for (let y = Math.max(0, y0); y <= Math.min(NY, y1 + 1); y++) { const s = Math.round(this.toScreen(0, y)[1]) + 0.5; g.moveTo(Math.max(left, a), s); g.lineTo(Math.min(left + w, p), s); }
      g.stroke();
    }
    g.strokeStyle = D.open ? "#d55e00" : "#8a929a";
    g.lineWidth = D.open ? 3 * c : 1;
    g.strokeRect(Math.round(a) + 0.5, Math.round(q) + 0.5, Math.round(p - a) - 1, Math.round(b - q) - 1);
  }

  axes(g) {
    const { left, top, w, h, c } = this;
    const [x0, y1] = this.toGrid(left, top), [x1, y0] = this.toGrid(left + w, top + h);
    g.strokeStyle = g.fillStyle = "#1d2126";
    g.lineWidth = Math.max(1, Math.round(c));
    g.strokeRect(left - g.lineWidth / 2, top - g.lineWidth / 2, w + g.lineWidth, h + g.lineWidth);
    g.font = `${12 * c}px system-ui, "Segoe UI", "Helvetica Neue", Arial, sans-serif`;
    g.beginPath();
    const along = ticks((x0 - 0.5) * RX, (x1 - 0.5) * RX, clamp(w / (44 * c), 2, 8));
    g.textAlign = "center"; g.textBaseline = "top";
    let free = -Infinity;
    for (const v of along.values) {
      const x = Math.round(this.toScreen(v / RX + 0.5, 0)[0]);
      if (x < left || x > left + w) continue;
      g.moveTo(x, top + h); g.lineTo(x, top + h + 5 * c);
      const text = along.text(v), half = g.measureText(text).width / 2;
      if (x - half < free) continue;
      g.fillText(text, x, top + h + 7 * c);
      free = x + half + 6 * c;
    }
    const up = ticks((y0 - 0.5) * RY, (y1 - 0.5) * RY, clamp(h / (40 * c), 2, 8));
    g.textAlign = "right"; g.textBaseline = "middle";
    for (const v of up.values) {
      const y = Math.round(this.toScreen(0, v / RY + 0.5)[1]);
      if (y < top || y > top + h) continue;
      g.moveTo(left - 5 * c, y); g.lineTo(left, y);
      g.fillText(up.text(v), left - 7 * c, y, left - 8 * c);
    }
    g.stroke();
    g.textAlign = "right"; g.textBaseline = "top";
    g.fillStyle = "#5d6670";
    g.fillText(`x, y${D.length_unit ? " / " + D.length_unit : ""}`, left + w, top + h + 23 * c);
  }

  bar(g) {
    const { left, top, w, h, c, field } = this, map = MAPS[field.map], { to, from } = SCALES[field.scale];
    const y = top + h + 42 * c, thick = 10 * c, blank = field.blank ? 34 * c : 0, x = left + blank, long = w - blank;
    const [low, high] = range(field), a = to(low), b = to(high);
    g.font = `${12 * c}px system-ui, "Segoe UI", "Helvetica Neue", Arial, sans-serif`;
    g.textBaseline = "top"; g.textAlign = "center";
    for (let n = 0; n < 256; n++) {
      g.fillStyle = css(map[n]);
      g.fillRect(x + Math.floor(long * n / 256), y, Math.ceil(long / 256) + 1, thick);
    }
    g.strokeStyle = "#1d2126";
    g.lineWidth = Math.max(1, Math.round(c));
    g.strokeRect(x, y, long, thick);
    g.fillStyle = "#1d2126";
    if (blank) {
      g.fillStyle = css(BLANK); g.fillRect(left, y, 14 * c, thick); g.strokeRect(left, y, 14 * c, thick);
      g.fillStyle = "#1d2126"; g.textAlign = "left";
      g.fillText(field.blank, left, y + thick + 4 * c, 62 * c);
      g.textAlign = "center";
    }
    const marks = field.scale === "log" ? logTicks(low, high, clamp(long / (60 * c), 2, 7))
      : (field.scale === "sqrt" ? sqrtTicks : ticks)(low, high, clamp(long / (45 * c), 2, 6));
    let free = left + (blank ? 66 * c : -1e9);
    g.beginPath();
    for (const v of marks.values) {
      const at = Math.round(x + long * (b > a ? (to(v) - a) / (b - a) : 0.5)), text = marks.text(v), half = g.measureText(text).width / 2;
      g.moveTo(at, y + thick); g.lineTo(at, y + thick + 3 * c);
      if (at - half < free || at + half > this.canvas.width) continue;
      g.fillText(text, at, y + thick + 4 * c);
      free = at + half + 8 * c;
    }
    g.stroke();
  }

  read() { // the value under the pointer, or in the middle of the view
    const [x, y] = hover || [view.x, view.y], found = isThere(this.field) && valueAt(this.field, x, y), { unit, blank } = this.field;
    this.output.textContent = !found ? "" : found[0] === null ? blank : `${rounded(found[0], found[2])}${unit ? " " + unit : ""}`;
    this.output.dataset.level = found ? found[1] : "";
  }
}

function spread(field) { // extremes of what is seen of a field, from up to 100 × 100 points
  const panel = panels.find(p => p.field === field), values = [];
  for (let a = 0.5; a < 100; a++) for (let b = 0.5; b < 100; b++) {
    const found = valueAt(field, ...panel.toGrid(panel.left + panel.w * a / 100, panel.top + panel.h * b / 100));
    if (found && found[0] !== null) values.push(found[0]);
  }
  const low = values.reduce((m, v) => Math.min(m, v), Infinity), high = values.reduce((m, v) => Math.max(m, v), -Infinity);
  return high > low ? [low, high] : null;
}

let settling = 0;
function settle() { // the colours follow the view when it has come to rest
  let changed = false;
  for (const { field } of panels) {
    const found = isThere(field) ? spread(field) : null;
    changed ||= String(found) !== String(field.seen || null);
    field.seen = found;
  }
  if (changed) repaint();
}

let asked = false;
function repaint() {
  if (asked) return;
  asked = true;
  requestAnimationFrame(() => {
    asked = false;
    now = performance.now();
    for (const panel of panels) panel.measure();
    if (!panels.length) return done();
    const p = panels[0], least = Math.min(p.w / NX / RX, p.h / NY / RY) * FINEST;
    view.zoom = view.whole ? least : clamp(view.zoom, least, Math.max(64 * p.c, least));
    const [sx, sy] = step(), half = [p.w / sx / 2, p.h / sy / 2];
    view.x = half[0] * 2 >= NX ? NX / 2 : clamp(view.x, half[0], NX - half[0]);
    view.y = half[1] * 2 >= NY ? NY / 2 : clamp(view.y, half[1], NY - half[1]);
    for (const panel of panels) panel.draw();
    drop();
    where(p);
    clearTimeout(settling);
    if (view.seen) settling = setTimeout(settle, 150);
    done();
  });
}

function done() { // for whoever waits for a picture that is complete
  document.documentElement.dataset.state = waiting ? "loading" : "complete";
  if (!waiting) document.documentElement.dataset.ready ||= Math.round(performance.now());
}

function where(panel) {
  const [x, y] = (hover || [view.x, view.y]).map(Math.floor), unit = D.length_unit ? ` ${D.length_unit}` : "";
  $("where").textContent = `${hover ? "At" : "In the middle:"} x = ${digits(x * RX, 6)}${unit}, y = ${digits(y * RY, 6)}${unit} (point ${x}, ${y})`;
  const scale = panel.c / step()[0], level = panels.reduce((m, p) => isThere(p.field) ? Math.max(m, p.finest) : m, 0);
  const every = level === 0 || !isFinite(level) ? "every point" : `every ${2 ** level}${level % 4 === 1 ? "nd" : "th"} point along x and y`;
  const zoomed = scale < 1 ? `a point is ${digits(1 / scale, 2)} pixels wide` : `a pixel is ${digits(scale, 2)} points wide`;
  $("resolution").textContent = waiting ? "loading …" : `${every[0].toUpperCase()}${every.slice(1)} is shown; ${zoomed}. ${folderMissing ? D.alone : D.tells}`;
  document.documentElement.dataset.level = level;
}

function zoom(factor, x = view.x, y = view.y) { // keeps the point (x, y) where it is
  const before = view.zoom;
  view.zoom *= factor;
  const p = panels[0], least = Math.min(p.w / NX / RX, p.h / NY / RY) * FINEST;
  view.zoom = clamp(view.zoom, least, Math.max(64 * p.c, least));
  view.whole = view.zoom <= least;
  const f = before / view.zoom;
  view.x = x + (view.x - x) * f;
  view.y = y + (view.y - y) * f;
  repaint();
}

function listen(panel) {
  const { canvas } = panel, fingers = new Map();
  const at = event => { const box = canvas.getBoundingClientRect(); return [(event.clientX - box.left) * panel.c, (event.clientY - box.top) * panel.c]; };
  canvas.addEventListener("pointerdown", event => { canvas.setPointerCapture(event.pointerId); fingers.set(event.pointerId, at(event)); canvas.classList.add("dragged"); });
  canvas.addEventListener("pointermove", event => {
    const place = at(event), old = fingers.get(event.pointerId), [sx, sy] = step();
    if (old && fingers.size === 1) {
      view.x -= (place[0] - old[0]) / sx;
      view.y += (place[1] - old[1]) / sy;
    } else if (old && fingers.size === 2) {
      const other = [...fingers].find(([id]) => id !== event.pointerId)[1];
      const far = (a, b) => Math.hypot(a[0] - b[0], a[1] - b[1]);
      zoom(far(place, other) / Math.max(far(old, other), 1), ...panel.toGrid(...other));
    }
    if (old) fingers.set(event.pointerId, place);
    hover = panel.toGrid(...place);
    if (hover[0] < 0 || hover[1] < 0 || hover[0] >= NX || hover[1] >= NY || place[1] > panel.top + panel.h || place[0] < panel.left) hover = null;
    repaint();
  });
  const lift = event => { fingers.delete(event.pointerId); canvas.classList.remove("dragged"); remember(); };
  canvas.addEventListener("pointerup", lift);
  canvas.addEventListener("pointercancel", lift);
  canvas.addEventListener("pointerleave", () => { hover = null; repaint(); });
  canvas.addEventListener("wheel", event => { event.preventDefault(); zoom(2 ** (-clamp(event.deltaY, -120, 120) / 240), ...panel.toGrid(...at(event))); remember(); }, { passive: false });
  canvas.addEventListener("dblclick", event => zoom(event.shiftKey ? 0.5 : 2, ...panel.toGrid(...at(event))));
  canvas.addEventListener("keydown", event => {
    const [sx, sy] = step(), far = panel.w / 8;
    const moves = { ArrowLeft: [-far / sx, 0], ArrowRight: [far / sx, 0], ArrowUp: [0, far / sy], ArrowDown: [0, -far / sy] };
    if (moves[event.key]) { view.x += moves[event.key][0]; view.y += moves[event.key][1]; repaint(); }
    else if (event.key === "+" || event.key === "=") zoom(1.5);
    else if (event.key === "-") zoom(1 / 1.5);
    else if (event.key === "0") whole();
    else return;
    event.preventDefault();
    remember();
  });
}

function whole() { view.whole = true; view.x = NX / 2; view.y = NY / 2; repaint(); }

// The view stands behind the # of the address: load, the point in the middle, pixels per point.
let timer = 0;
function remember() {
  clearTimeout(timer);
  timer = setTimeout(() => {
    const words = { load: view.load, x: view.x.toFixed(2), y: view.y.toFixed(2), zoom: view.whole ? 0 : +(view.zoom / panels[0].c).toPrecision(4) };
    try { history.replaceState(null, "", "#" + new URLSearchParams(words)); } catch { /* not allowed here */ }
  }, 300);
}

function recall() {
  const words = new URLSearchParams(location.hash.slice(1)), number = name => words.has(name) && isFinite(words.get(name)) ? +words.get(name) : null;
  if (D.shown.includes(number("load"))) view.load = number("load");
  view.x = number("x") ?? view.x;
  view.y = number("y") ?? view.y;
  view.zoom = (number("zoom") ?? 0) * Math.max(1, window.devicePixelRatio || 1);
  view.whole = !view.zoom;
  view.seen = words.has("seen") || view.seen;
  choose(view.load);
}

// ---- curves -------------------------------------------------------------------------------------------------------

const SVG = "http://www.w3.org/2000/svg";
function node(name, attributes, parent, text) {
  const made = document.createElementNS(SVG, name);
  for (const key in attributes) made.setAttribute(key, attributes[key]);
  if (text !== undefined) made.textContent = text;
  parent.append(made);
  return made;
}

function chart(spec) { // curves of the load that is chosen in colour, those of the others in grey
  const W = 420, H = 300, box = { l: 52, r: 408, t: 12, b: 252 };
  const curves = spec.curves.filter(curve => curve.x.length);
  const all = name => curves.flatMap(curve => curve[name]).filter(v => spec[name + "log"] ? v > 0 : isFinite(v));
  const limits = name => {
    let low = Math.min(...all(name)), high = Math.max(...all(name));
    if (spec[name + "log"]) return [low / (high / low) ** 0.03, high * (high / low) ** 0.03].map((v, n) => low === high ? v * [0.5, 2][n] : v);
    const pad = 0.04 * (high - low || Math.abs(high) || 1);
    return [low >= 0 && low < 0.3 * high ? 0 : low - pad, high + pad];
  };
  const div = make("div", undefined, $("charts"));
  lettered(make("h2", undefined, div), spec.title);
  const legend = make("div", undefined, div);
  legend.className = "legend";
  const svg = node("svg", { viewBox: `0 0 ${W} ${H}`, role: "img", "aria-label": spec.title }, div);
  const axis = { x: limits("x"), y: limits("y") };
  const place = (name, v) => {
    const [low, high] = axis[name], t = spec[name + "log"] ? Math.log(v / low) / Math.log(high / low) : (v - low) / (high - low);
    return name === "x" ? box.l + t * (box.r - box.l) : box.b - t * (box.b - box.t);
  };
  for (const name of ["x", "y"]) {
    const marks = (spec[name + "log"] ? logTicks : ticks)(...axis[name], name === "x" ? 6 : 5);
    for (const v of marks.values) {
      const p = place(name, v), x = name === "x";
      node("line", x ? { x1: p, x2: p, y1: box.t, y2: box.b, stroke: "#e8ebee" } : { x1: box.l, x2: box.r, y1: p, y2: p, stroke: "#e8ebee" }, svg);
      node("text", x ? { x: p, y: box.b + 17, "text-anchor": "middle" } : { x: box.l - 7, y: p + 4, "text-anchor": "end" }, svg, marks.text(v));
    }
  }
  node("rect", { x: box.l, y: box.t, width: box.r - box.l, height: box.b - box.t, fill: "none", stroke: "#1d2126" }, svg);
  lettered(node("text", { x: (box.l + box.r) / 2, y: H - 10, "text-anchor": "middle" }, svg), spec.xlabel, true);
  if (spec.mark) {
    const p = place("x", spec.mark[0]);
    if (p > box.l && p < box.r) {
      node("line", { x1: p, x2: p, y1: box.t, y2: box.b, stroke: "#5d6670", "stroke-dasharray": "2 3" }, svg);
      lettered(node("text", { x: p - 5, y: box.t + 15, "text-anchor": "end", class: "soft" }, svg), spec.mark[1], true);
    }
  }
  const layer = node("g", {}, svg);
  const number = `clip${document.querySelectorAll("clipPath").length}`;
  node("rect", { x: box.l, y: box.t, width: box.r - box.l, height: box.b - box.t }, node("clipPath", { id: number }, svg));
  layer.setAttribute("clip-path", `url(#${number})`);
  const paint = () => {
    layer.replaceChildren();
    legend.replaceChildren();
    const chosen = curve => curve.load === undefined || curve.load === view.load;
    for (const curve of [...curves].sort((a, b) => chosen(a) - chosen(b))) {
      const colour = chosen(curve) ? curve.colour : "#c9ced3";
      if (!chosen(curve) && curve.alone) continue;
      const points = curve.x.map((x, n) => [x, curve.y[n]]).filter(([x, y]) => isFinite(x) && isFinite(y) && (!spec.xlog || x > 0) && (!spec.ylog || y > 0)).map(([x, y]) => [place("x", x), place("y", y)]);
      if (curve.dots) {
        curve.error?.forEach((e, n) => { if (e > 0) node("line", { x1: points[n][0], x2: points[n][0], y1: place("y", curve.y[n] + e), y2: place("y", spec.ylog ? Math.max(curve.y[n] - e, axis.y[0]) : curve.y[n] - e), stroke: colour }, layer); });
        for (const [n, [x, y]] of points.entries()) node("circle", { cx: x, cy: y, r: curve.loads ? (curve.loads[n] === view.load ? 5 : 3.4) : chosen(curve) ? 2.4 : 1, fill: curve.loads && curve.loads[n] !== view.load ? "#fff" : colour, stroke: colour, "stroke-width": 1.3 }, layer);
      } else if (points.length) {
        node("polyline", { points: points.map(p => p.map(v => v.toFixed(1)).join()).join(" "), fill: "none", stroke: colour, "stroke-width": chosen(curve) ? 1.8 : 1, "stroke-dasharray": curve.dash || "" }, layer);
      }
      if (chosen(curve) && curve.name) {
        const entry = make("span", undefined, legend), sign = make("i", undefined, entry);
        if (curve.dots) { sign.className = "dot"; sign.style.background = curve.colour; }
        else sign.style.borderTop = `2px ${curve.dash ? "dashed" : "solid"} ${curve.colour}`;
        entry.append(curve.name);
      }
    }
  };
  paint();
  return paint;
}

// ---- the page -----------------------------------------------------------------------------------------------------

function choose(load) {
  view.load = load;
  $("load").value = load;
  for (const row of document.querySelectorAll("#table tbody tr")) row.setAttribute("aria-selected", +row.dataset.load === load);
  for (const paint of charts) paint();
  repaint();
}

document.title = `${D.title} – pgfmd`;
$("title").textContent = D.title;
$("subtitle").textContent = D.subtitle;
for (const [index, text] of D.loads) make("option", text, $("load")).value = index;
if (D.loads.length < 2) $("load").parentElement.hidden = true;
for (const field of D.fields) panels.push(new Panel(field));
$("panels").style.setProperty("--columns", panels.length);
if (!panels.length) for (const id of ["where", "resolution"]) $(id).hidden = true;
if (!panels.length) for (const group of document.querySelectorAll("nav .group")) group.hidden = true;
$("overlay-group").hidden = !D.fields.some(f => f.key === "pressure" && f.blank) || !D.fields.some(f => f.key === "height");

const head = make("tr", undefined, make("thead", undefined, $("table")));
for (const { name, unit, about } of D.columns) { const cell = lettered(make("th", undefined, head), name); cell.title = about; make("small", unit, cell); }
const body = make("tbody", undefined, $("table"));
for (const [index, row] of D.rows) {
  const line = make("tr", undefined, body);
  line.dataset.load = index;
  for (const text of row) make("td", text, line);
  line.className = "can";
  line.tabIndex = 0;
  line.addEventListener("click", () => choose(index));
  line.addEventListener("keydown", event => { if (event.key === "Enter") choose(index); });
}
for (const [name, text] of D.facts) { make("dt", name, $("facts")); make("dd", text, $("facts")); }
$("job").textContent = D.job;
for (const note of D.notes) make("li", note, $("notes"));
const charts = D.charts.map(chart);

$("load").addEventListener("change", () => { choose(+$("load").value); remember(); });
$("whole").addEventListener("click", () => { whole(); remember(); });
$("in").addEventListener("click", () => { zoom(2); remember(); });
$("out").addEventListener("click", () => { zoom(0.5); remember(); });
$("peak").addEventListener("click", () => { [view.x, view.y] = D.peak; view.zoom = 8 * panels[0].c; view.whole = false; repaint(); remember(); });
$("overlay").addEventListener("change", repaint);
for (const id of ["all", "seen"]) $(id).addEventListener("click", () => {
  view.seen = id === "seen";
  for (const other of ["all", "seen"]) $(other).setAttribute("aria-pressed", other === id);
  repaint();
});
$("large").addEventListener("click", () => {
  $("large").setAttribute("aria-pressed", $("panels").classList.toggle("large"));
  repaint();
});
window.addEventListener("resize", repaint);
window.addEventListener("hashchange", recall);
window.addEventListener("beforeprint", () => { hover = null; });
recall();
