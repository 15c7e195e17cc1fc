
// The page of a running scan: draws what the socket sends.
class LivePage {
  constructor(root) {
    const data = root.dataset;
    this.map = new SurfaceMap(
      document.getElementById("map"), document.getElementById("readout"), data.palette, data.missing);
    this.layer = 0;
    this.generation = -1;
    this.frames = 0;
    root.addEventListener("click", (event) => {
      const chosen = event.target.dataset;
      if (chosen.layer !== undefined) { this.layer = Number(chosen.layer); this.mark(); this.redraw(true); }
      if (chosen.whole !== undefined) this.map.whole();
    });
    this.connect(500);
  }

  mark() {
    for (const button of document.querySelectorAll("button[data-layer]"))
      button.setAttribute("aria-pressed", Number(button.dataset.layer) === this.layer);
  }

  // After a loss it connects again by itself, and gets everything anew.
  connect(pause) {
    const place = new URL("live", location.href);
    place.protocol = place.protocol.replace("http", "ws");
    place.search = location.search;
    const socket = new WebSocket(place);
    socket.binaryType = "arraybuffer";
    const link = document.getElementById("link");
    socket.onopen = () => { link.textContent = "live"; this.generation = -1; pause = 500; };
    socket.onmessage = (message) =>
      typeof message.data === "string" ? this.state(JSON.parse(message.data)) : this.news(message.data);
    socket.onclose = () => {
      // A scan that has ended keeps its last state on the page.
      const ended = this.latest && this.latest.points > 0;
      link.textContent = ended
        ? `the viewer has ended; this is the state of ${new Date().toLocaleTimeString()}`
        : "no connection to the viewer; trying again";
      if (!ended) {
        document.getElementById("light").className = "light amber";
        document.querySelector("#light strong").textContent = "Waiting for the viewer";
      }
      setTimeout(() => this.connect(Math.min(2 * pause, 5000)), pause);
    };
  }

  // --- the map

  news(buffer) {
    const head = new DataView(buffer);
    const cells = head.getUint32(0, true), generation = head.getUint32(4, true);
    const count = head.getUint32(8, true);
    if (generation !== this.generation) {
      this.generation = generation;
      this.cells = cells;
      this.layers = [0, 1, 2].map(() => new Float32Array(cells * cells).fill(NaN));
      this.fresh = true;
    }
    // The numbers begin at a multiple of four bytes.
    const places = new Uint32Array(buffer, 20, count);
    for (let k = 0; k < 3; k++) {
      const values = new Float32Array(buffer, 20 + 4 * count * (k + 1), count);
      for (let i = 0; i < count; i++) this.layers[k][places[i]] = values[i];
    }
    this.redraw(false);
  }

  redraw(chosen) {
    if (!this.layers || !this.grid || this.grid.generation !== this.generation) return;
    const heights = filled(this.layers[this.layer], this.cells);
    const limits = robust(this.layers[this.layer], this.layer === 2);
    const { left, bottom, pitch } = this.grid, size = pitch * this.cells;
    const extent = [left, left + size, bottom, bottom + size].map((edge) => 1e3 * edge);
    const micro = Math.max(Math.abs(limits[0]), Math.abs(limits[1])) > 2000;
    const unit = micro ? "µm" : "nm";
    const scaled = micro ? heights.map((h) => h / 1000) : heights;
    const shown = micro ? limits.map((h) => h / 1000) : limits;
    if (this.fresh || chosen) {
      this.map.set(scaled, this.cells, this.cells, extent, shown, unit);
      this.fresh = false;
    } else {
      // In place, so that an enlarged part stays enlarged.
      Object.assign(this.map, { heights: scaled, unit, extent });
      this.map.colour(shown);
    }
    this.frames++;
  }

  // --- everything else

  state(view) {
    this.grid = view.grid;
    this.latest = view;
    const light = document.getElementById("light");
    light.className = `light ${view.light.colour}`;
    light.querySelector("strong").textContent = view.light.word;
    const lapse = view.nodes.map((node) => Number(node.values.time_lapse)).find((one) => one > 0 && one !== 1);
    document.getElementById("link").textContent = lapse
      ? `live; an emulated machine in time lapse: one second here is ${lapse} s of the machine` : "live";
    list(light.querySelector("ul"), view.light.reasons);
    document.querySelector("button[data-layer='0']").textContent = view.compared ? "Deviation" : "Height";
    this.numbers(view);
    const calibration = view.calibration;
    document.getElementById("calibration").textContent = calibration.id
      ? `${calibration.id.slice(0, 12)}: ${calibration.verdict}, lag ${(1e6 * calibration.delay).toFixed(1)} µs`
      : "none yet";
    this.tables(view.nodes, view.ended);
    // Before the first points there is nothing to draw.
    document.getElementById("map").hidden = !view.grid;
    document.getElementById("history").hidden = view.series.length < 2;
    series(document.getElementById("series"), view.series);
    document.getElementById("vibration").hidden = !view.spectrum;
    if (view.spectrum) spectrum(document.getElementById("spectrum"), view.spectrum);
    if (this.fresh) this.redraw(false);
  }

  numbers(view) {
    const last = view.series.length ? view.series[view.series.length - 1] : null;
    const entries = [["points", view.points.toLocaleString("en").replaceAll(",", " ")]];
    if (view.left_out) entries.push(["without a place", String(view.left_out)]);
    if (last) entries.push(
      ["dynamic error, last second", `${length(last[2] - last[1])} PV`],
      ["standard uncertainty", length(last[3])]);
    const root = document.getElementById("numbers");
    root.replaceChildren(...entries.map(([name, value]) => {
      const item = document.createElement("div");
      item.append(element("dt", name), element("dd", value));
      return item;
    }));
    document.getElementById("reduction").textContent = view.grid
      ? `A reduction: each cell of ${(1e6 * view.grid.pitch).toFixed(0)} µm shows the mean of its points; `
        + "cells without a point show their neighbours'. Drag, pinch or turn the wheel to enlarge."
      : "No points yet: the map grows while a part is scanned with a calibration in force.";
  }

  tables(nodes, ended) {
    const rows = nodes.map((node) => {
      const row = document.createElement("tr");
      const gone = node.silent && !ended;
      row.className = `level-${gone ? "ERROR" : node.level}`;
      const said = element("td", gone ? "no message for 10 s" : node.silent ? "ended" : node.message);
      said.className = "said";
      row.append(element("th", node.name), element("td", gone ? "SILENT" : node.level), said);
      return row;
    });
    document.querySelector("#nodes tbody").replaceChildren(...rows);
    const losses = [];
    for (const node of nodes)
      for (const [name, value] of Object.entries(node.values))
        if (LOSSES.test(name) && Number(value) > 0) {
          const row = document.createElement("tr");
          row.append(element("th", `${node.name.split("/").pop()}: ${name.replaceAll("_", " ")}`), element("td", value));
          losses.push(row);
        }
    if (!losses.length) {
      const row = document.createElement("tr");
      row.append(element("th", "none"));
      losses.push(row);
    }
    document.querySelector("#losses tbody").replaceChildren(...losses);
  }
}

// Whole words of a count's name: "late", not "latency_max_ms".
const LOSSES =
  /(^|_)(lost|refused|unmatched|invalid|duplicates?|missing|late|overdue|settling|bad|slipped|beyond)(_|$)/;

// A length in nm, or µm from a micrometre on.
function length(metres) {
  return metres < 999.5e-9 ? `${(1e9 * metres).toPrecision(3)} nm` : `${(1e6 * metres).toPrecision(3)} µm`;
}

function element(kind, content) {
  const made = document.createElement(kind);
  made.textContent = content;
  return made;
}

function list(root, texts) {
  root.replaceChildren(...texts.map((one) => element("li", one)));
}

// Cells without a point between two turns of a spiral show the mean of their neighbours.
function filled(values, cells) {
  const out = values.slice();
  for (let row = 1; row < cells - 1; row++)
    for (let column = 1; column < cells - 1; column++) {
      const at = row * cells + column;
      if (!Number.isNaN(values[at])) continue;
      let sum = 0, count = 0;
      for (let dr = -cells; dr <= cells; dr += cells)
        for (let dc = -1; dc <= 1; dc++) {
          const value = values[at + dr + dc];
          if (!Number.isNaN(value)) { sum += value; count++; }
        }
      if (count > 1) out[at] = sum / count;
    }
  return out;
}

// The range of 99.5 % of the cells; about zero for what has two signs.
function robust(values, positive) {
  const known = values.filter((value) => !Number.isNaN(value)).sort();
  if (!known.length) return [0, 1];
  const low = known[Math.floor(0.0025 * (known.length - 1))];
  const high = known[Math.ceil(0.9975 * (known.length - 1))];
  if (positive || low > 0 || high < 0) return [low, high > low ? high : low + 1];
  const bound = Math.max(-low, high) || 1;
  return [-bound, bound];
}

function chart(canvas, x, lines, unit, label, logarithmic) {
  const dense = window.devicePixelRatio || 1, box = canvas.getBoundingClientRect();
  if (!box.width || x.length < 2) return;
  canvas.width = Math.round(box.width * dense);
  canvas.height = Math.round(box.height * dense);
  const pen = canvas.getContext("2d");
  pen.setTransform(dense, 0, 0, dense, 0, 0);
  pen.font = "11px system-ui, 'DejaVu Sans', sans-serif";
  const left = 48, right = box.width - 8, top = 22, bottom = box.height - 28;
  const f = logarithmic ? (v) => Math.log10(Math.max(v, 1e-12)) : (v) => v;
  const all = lines.flatMap((line) => line.values.map(f)).filter(Number.isFinite);
  let low = Math.min(...all, logarithmic ? Infinity : 0), high = Math.max(...all);
  if (!(high > low)) high = low + 1;
  const px = (v) => left + ((v - x[0]) / (x[x.length - 1] - x[0] || 1)) * (right - left);
  const py = (v) => bottom - ((v - low) / (high - low)) * (bottom - top);
  pen.fillStyle = "#66727f";
  pen.textAlign = "right";
  pen.textBaseline = "middle";
  pen.strokeStyle = "#dde2e7";
  for (const mark of ticks(low, high, 4)) {
    pen.fillText(logarithmic ? `1e${mark}` : text(mark), left - 5, py(mark));
    pen.beginPath(); pen.moveTo(left, py(mark)); pen.lineTo(right, py(mark)); pen.stroke();
  }
  pen.textAlign = "center";
  pen.textBaseline = "top";
  for (const mark of ticks(x[0], x[x.length - 1], 6)) pen.fillText(text(mark), px(mark), bottom + 3);
  pen.fillText(label, (left + right) / 2, bottom + 15);
  pen.textAlign = "left";
  pen.fillText(unit, 2, 0);
  for (const line of lines) {
    pen.strokeStyle = line.colour;
    pen.lineWidth = 1.4;
    pen.beginPath();
    line.values.forEach((v, i) => (i ? pen.lineTo(px(x[i]), py(f(v))) : pen.moveTo(px(x[i]), py(f(v)))));
    pen.stroke();
  }
}

function series(canvas, rows) {
  const nm = (k) => rows.map((row) => 1e9 * row[k]);
  chart(canvas, rows.map((row) => row[0]), [
    { values: nm(1), colour: "#D55E00" }, { values: nm(2), colour: "#D55E00" },
    { values: nm(3), colour: "#0072B2" },
  ], "nm", "seconds ago", false);
}

function spectrum(canvas, found) {
  chart(canvas, found.frequency.slice(1), [{ values: found.amplitude.slice(1), colour: "#0072B2" }],
    "m/s²/√Hz", "Hz", true);
}

const livePage = new LivePage(document.getElementById("live"));
