// A map of heights on a canvas: enlarge, move, read a value, choose the range of the colours.
// No library, nothing fetched. The page of a measurement embeds it; a live page may call set().
"use strict";

class SurfaceMap {
  // canvas: to draw on; readout: element for the value under the pointer
  // colours: palette as "rrggbb…" of any number of steps; missing: colour of what has no height
  constructor(canvas, readout, colours, missing) {
    this.canvas = canvas;
    this.readout = readout;
    this.palette = [];
    for (let i = 0; i < colours.length; i += 6)
      this.palette.push([0, 2, 4].map((k) => parseInt(colours.substr(i + k, 2), 16)));
    this.missing = [0, 2, 4].map((k) => parseInt(missing.substr(k, 2), 16));
    this.pointers = new Map();
    this.listen();
    new ResizeObserver(() => this.draw()).observe(canvas);
  }

  // heights: row by row from the least y; extent: left, right, bottom, top; NaN = missing
  set(heights, rows, columns, extent, limits, unit) {
    Object.assign(this, { heights, rows, columns, extent, unit });
    this.whole();
    this.colour(limits);
  }

  colour(limits) {
    this.limits = limits;
    const image = new ImageData(this.columns, this.rows);
    const [low, high] = limits, last = this.palette.length - 1;
    for (let row = 0; row < this.rows; row++)
      for (let column = 0; column < this.columns; column++) {
        const height = this.heights[row * this.columns + column];
        const share = (height - low) / (high - low || 1);
        const rgb = Number.isNaN(height) ? this.missing
          : this.palette[Math.max(0, Math.min(last, Math.round(share * last)))];
        const at = 4 * ((this.rows - 1 - row) * this.columns + column);
        image.data.set([...rgb, 255], at);
      }
    this.picture = document.createElement("canvas");
    this.picture.width = this.columns;
    this.picture.height = this.rows;
    this.picture.getContext("2d").putImageData(image, 0, 0);
    this.draw();
  }

  whole() {
    this.zoom = 1;
    this.centre = [this.columns / 2, this.rows / 2];
    if (this.picture) this.draw();
  }

  // --- geometry: places of the canvas in CSS pixels, of the picture in its pixels

  get field() {
    const box = this.canvas.getBoundingClientRect();
    return { left: 46, top: 8, width: Math.max(box.width - 46 - 92, 40), height: Math.max(box.height - 8 - 34, 40) };
  }

  get scale() {
    const field = this.field;
    return this.zoom * Math.min(field.width / this.columns, field.height / this.rows);
  }

  toPicture(x, y) {
    const field = this.field;
    return [
      this.centre[0] + (x - field.left - field.width / 2) / this.scale,
      this.centre[1] + (y - field.top - field.height / 2) / this.scale,
    ];
  }

  toCanvas(column, row) {
    const field = this.field;
    return [
      field.left + field.width / 2 + (column - this.centre[0]) * this.scale,
      field.top + field.height / 2 + (row - this.centre[1]) * this.scale,
    ];
  }

  // Lengths in the unit of the extent.
  place(column, row) {
    const [left, right, bottom, top] = this.extent;
    return [left + (column / this.columns) * (right - left), top - (row / this.rows) * (top - bottom)];
  }

  zoomAt(x, y, factor) {
    const before = this.toPicture(x, y);
    this.zoom = Math.max(1, Math.min(this.zoom * factor, Math.max(this.columns, this.rows) / 8));
    const after = this.toPicture(x, y);
    this.shift(before[0] - after[0], before[1] - after[1]);
  }

  shift(columns, rows) {
    this.centre[0] = Math.max(0, Math.min(this.columns, this.centre[0] + columns));
    this.centre[1] = Math.max(0, Math.min(this.rows, this.centre[1] + rows));
    if (this.zoom === 1) this.centre = [this.columns / 2, this.rows / 2];
    this.draw();
  }

  // --- drawing

  draw() {
    if (!this.picture) return;
    const box = this.canvas.getBoundingClientRect();
    const dense = window.devicePixelRatio || 1;
    const width = Math.round(box.width * dense), height = Math.round(box.height * dense);
    if (!width || !height) return;
    if (this.canvas.width !== width) this.canvas.width = width;
    if (this.canvas.height !== height) this.canvas.height = height;
    const pen = this.canvas.getContext("2d");
    pen.setTransform(dense, 0, 0, dense, 0, 0);
    pen.clearRect(0, 0, box.width, box.height);
    pen.font = "11.5px system-ui, 'DejaVu Sans', sans-serif";
    const field = this.field;
    pen.save();
    pen.beginPath();
    pen.rect(field.left, field.top, field.width, field.height);
    pen.clip();
    pen.imageSmoothingEnabled = false;
    const [x, y] = this.toCanvas(0, 0);
    pen.drawImage(this.picture, x, y, this.columns * this.scale, this.rows * this.scale);
    pen.restore();
    this.drawAxes(pen, field);
    this.drawBar(pen, field, box.width);
  }

  drawAxes(pen, field) {
    const first = this.place(...this.toPicture(field.left, field.top + field.height));
    const last = this.place(...this.toPicture(field.left + field.width, field.top));
    pen.strokeStyle = "#66727f";
    pen.fillStyle = "#1f2933";
    pen.lineWidth = 0.7;
    pen.beginPath();
    pen.textAlign = "center";
    pen.textBaseline = "top";
    for (const mark of ticks(first[0], last[0], field.width / 45)) {
      const x = field.left + ((mark - first[0]) / (last[0] - first[0])) * field.width;
      pen.moveTo(x, field.top + field.height);
      pen.lineTo(x, field.top + field.height + 4);
      pen.fillText(text(mark), x, field.top + field.height + 6);
    }
    pen.fillText("x [mm]", field.left + field.width / 2, field.top + field.height + 20);
    pen.textAlign = "right";
    pen.textBaseline = "middle";
    for (const mark of ticks(first[1], last[1], field.height / 50)) {
      const y = field.top + field.height - ((mark - first[1]) / (last[1] - first[1])) * field.height;
      pen.moveTo(field.left, y);
      pen.lineTo(field.left - 4, y);
      pen.fillText(text(mark), field.left - 6, y);
    }
    pen.stroke();
    pen.save();
    pen.translate(9, field.top + field.height / 2);
    pen.rotate(-Math.PI / 2);
    pen.textAlign = "center";
    pen.fillText("y [mm]", 0, 0);
    pen.restore();
  }

  drawBar(pen, field, width) {
    const left = width - 74, top = field.top + 18, high = field.height - 36;
    const last = this.palette.length - 1;
    for (let i = 0; i <= last; i++) {
      pen.fillStyle = `rgb(${this.palette[i]})`;
      pen.fillRect(left, top + (1 - (i + 1) / (last + 1)) * high, 12, high / (last + 1) + 0.6);
    }
    pen.fillStyle = "#1f2933";
    pen.textAlign = "left";
    pen.textBaseline = "middle";
    const [low, upper] = this.limits;
    for (const mark of ticks(low, upper, high / 40))
      pen.fillText(text(mark), left + 17, top + (1 - (mark - low) / (upper - low || 1)) * high);
    pen.textBaseline = "bottom";
    pen.fillText(this.unit, left, top - 5);
  }

  // --- the reader's hands

  listen() {
    const canvas = this.canvas;
    canvas.style.touchAction = "none";
    const at = (event) => {
      const box = canvas.getBoundingClientRect();
      return [event.clientX - box.left, event.clientY - box.top];
    };
    canvas.addEventListener("wheel", (event) => {
      event.preventDefault();
      this.zoomAt(...at(event), Math.exp(-event.deltaY / 400));
    }, { passive: false });
    canvas.addEventListener("pointerdown", (event) => {
      canvas.setPointerCapture(event.pointerId);
      this.pointers.set(event.pointerId, at(event));
    });
    for (const end of ["pointerup", "pointercancel", "pointerleave"])
      canvas.addEventListener(end, (event) => this.pointers.delete(event.pointerId));
    canvas.addEventListener("pointermove", (event) => this.moved(event.pointerId, at(event)));
    canvas.addEventListener("dblclick", () => this.whole());
    canvas.tabIndex = 0;
    canvas.addEventListener("keydown", (event) => {
      const step = 40 / this.scale, field = this.field;
      const middle = [field.left + field.width / 2, field.top + field.height / 2];
      const keys = {
        "+": () => this.zoomAt(...middle, 1.4), "-": () => this.zoomAt(...middle, 1 / 1.4),
        "0": () => this.whole(), ArrowLeft: () => this.shift(-step, 0),
        ArrowRight: () => this.shift(step, 0), ArrowUp: () => this.shift(0, -step),
        ArrowDown: () => this.shift(0, step),
      };
      if (!keys[event.key]) return;
      event.preventDefault();
      keys[event.key]();
    });
  }

  moved(pointer, here) {
    if (!this.picture) return;
    const before = this.pointers.get(pointer);
    if (before && this.pointers.size === 1)
      this.shift((before[0] - here[0]) / this.scale, (before[1] - here[1]) / this.scale);
    if (before && this.pointers.size === 2) {
      const other = [...this.pointers].find(([id]) => id !== pointer)[1];
      const apart = (a) => Math.hypot(a[0] - other[0], a[1] - other[1]) || 1;
      this.zoomAt((here[0] + other[0]) / 2, (here[1] + other[1]) / 2, apart(here) / apart(before));
    }
    if (before) this.pointers.set(pointer, here);
    this.tell(here);
  }

  tell(here) {
    const [column, row] = this.toPicture(...here).map(Math.floor);
    const inside = column >= 0 && column < this.columns && row >= 0 && row < this.rows;
    const height = inside ? this.heights[(this.rows - 1 - row) * this.columns + column] : NaN;
    const [x, y] = this.place(column + 0.5, row + 0.5);
    this.readout.textContent = Number.isNaN(height) ? " "
      : `x ${x.toFixed(3)} mm, y ${y.toFixed(3)} mm: ${height.toPrecision(4)} ${this.unit}`;
  }
}

// About so many round numbers from low to high.
function ticks(low, high, about) {
  const span = high - low;
  if (!(span > 0)) return [low];
  const rough = span / Math.max(about, 1), power = 10 ** Math.floor(Math.log10(rough));
  const step = [1, 2, 5, 10].find((n) => n * power >= rough) * power;
  const found = [];
  for (let n = Math.ceil(low / step); n * step <= high + 1e-9 * span; n++) found.push(n * step);
  return found;
}

function text(number) {
  const rounded = Math.abs(number) < 1e-12 ? 0 : parseFloat(number.toPrecision(6));
  return String(rounded).replace("-", "\u2212");
}

// Heights from a picture whose red and green are the two bytes of a step; step 0 = missing.
async function decoded(address, least, step) {
  const picture = new Image();
  // The page has not loaded before its pictures have: whoever prints it then finds the map drawn.
  await new Promise((done, failed) => {
    picture.onload = done;
    picture.onerror = failed;
    picture.src = address;
  });
  const canvas = document.createElement("canvas");
  canvas.width = picture.naturalWidth;
  canvas.height = picture.naturalHeight;
  const pen = canvas.getContext("2d", { willReadFrequently: true });
  pen.drawImage(picture, 0, 0);
  const bytes = pen.getImageData(0, 0, canvas.width, canvas.height).data;
  const heights = new Float32Array(canvas.width * canvas.height);
  for (let i = 0; i < heights.length; i++) {
    const code = 256 * bytes[4 * i] + bytes[4 * i + 1];
    heights[i] = code ? least + (code - 1) * step : NaN;
  }
  return { heights, rows: canvas.height, columns: canvas.width };
}

// One element of a page: a canvas, a readout, buttons for the layers and for the range.
async function surfaceMapIn(root) {
  const content = JSON.parse(root.querySelector("script[type='application/json']").textContent);
  const map = new SurfaceMap(
    root.querySelector("canvas"), root.querySelector("output"), content.colours, content.missing);
  let layer = 0, robust = true;
  const layers = await Promise.all(content.layers.map(async (one) => ({
    ...one, ...(await decoded(`data:image/png;base64,${one.png}`, one.least, one.step)),
  })));
  const range = (one) => (robust ? one.robust : one.full);
  const show = () => {
    const one = layers[layer];
    map.set(one.heights, one.rows, one.columns, one.extent, range(one), one.unit);
    mark();
  };
  const mark = () => {
    for (const button of root.querySelectorAll("button[data-layer]"))
      button.setAttribute("aria-pressed", Number(button.dataset.layer) === layer);
    for (const button of root.querySelectorAll("button[data-range]"))
      button.setAttribute("aria-pressed", (button.dataset.range === "robust") === robust);
  };
  root.addEventListener("click", (event) => {
    const chosen = event.target.dataset;
    if (chosen.layer !== undefined) { layer = Number(chosen.layer); show(); }
    if (chosen.range !== undefined) { robust = chosen.range === "robust"; map.colour(range(layers[layer])); mark(); }
    if (chosen.whole !== undefined) map.whole();
  });
  root.classList.add("alive");
  show();
  addEventListener("beforeprint", () => map.whole());
}

document.querySelectorAll(".surface-map").forEach(surfaceMapIn);
