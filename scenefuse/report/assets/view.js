const unpack = (text) => Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0));
const inflate = async (text) => {
  const stream = new Blob([unpack(text)]).stream().pipeThrough(new DecompressionStream("deflate"));
  return new Uint8Array(await new Response(stream).arrayBuffer());
};

// K3D comes as an AMD module without dependencies; it is unpacked once, when the first view comes near.
let k3d = null;
const library = () => k3d ??= inflate(document.getElementById("k3d").textContent).then((bytes) => {
  let found;
  new Function("define", new TextDecoder().decode(bytes))((_name, _needs, make) => { found = make(); });
  return found;
});

// Every view holds a WebGL context, and browsers drop the oldest of too many.
const MOST_LIVE = 4, live = [];
const FIELD_OF_VIEW = 35;
const UNMOVED = { data: new Float32Array([1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]), shape: [4, 4] };

const planesOf = (names, bytes, count) =>
  Object.fromEntries(names.map((name, k) => [name, bytes.subarray(k * count, (k + 1) * count)]));

// The rows of columns that are held as differences.
const rows = (names, planes, count, of) => {
  const values = new Float32Array(names.length * count);
  names.forEach((name, a) => {
    const low = planes[name + "_low"], high = planes[name + "_high"];
    for (let i = 0, cell = 0; i < count; i++) {
      const folded = low[i] | (high[i] << 8);
      cell = (cell + (folded & 1 ? -(folded + 1) >> 1 : folded >> 1)) & 65535;
      values[names.length * i + a] = of(cell, a);
    }
  });
  return values;
};
const placesOf = (about, planes, count) =>
  rows(["x", "y", "z"], planes, count, (cell, a) => about.corner[a] + cell * about.step[a]);

const decode = (about, bytes) => {
  const counts = about.points, count = counts.before + counts.both + counts.after;
  const planes = planesOf(about.planes, bytes, count), positions = placesOf(about, planes, count);
  const [least, largest] = about.radius, diameters = {};
  for (const when of ["before", "after"]) {
    const levels = planes["radius_" + when];
    diameters[when] = Float32Array.from(levels, (v) => 2 * least * (largest / least) ** ((v - 1) / (about.levels - 1)));
  }
  const runs = { before: [0, counts.before + counts.both], after: [counts.before, count] };
  // On the surface the points after are picked, on which it lies.
  runs.surface = runs.after;
  diameters.surface = diameters.after;
  return { count, planes, positions, diameters, runs };
};

const decodeMesh = (about, bytes, picture) => {
  const { vertices: count, faces } = about, planes = planesOf(about.planes, bytes, count);
  const uvs = picture.length ? rows(["u", "v"], planes, count, (cell) => cell / 65535) : null;
  const corner = planesOf([...Array(9).keys()], bytes.subarray(about.planes.length * count), faces);
  const indices = new Uint32Array(3 * faces);
  for (let f = 0, first = 0; f < faces; f++) {
    const beyond = (k) => corner[k][f] | (corner[k + 1][f] << 8) | (corner[k + 2][f] << 16);
    first += beyond(0);
    indices.set([first, first + beyond(3), first + beyond(6)], 3 * f);
  }
  return { count, planes, positions: placesOf(about, planes, count), uvs, indices, picture };
};

const hex = (color) => parseInt(color.slice(1), 16);
const dimmed = (color, shade) => ((((color >> 16) * shade) & 255) << 16)
  | (((((color >> 8) & 255) * shade) & 255) << 8) | (((color & 255) * shade) & 255);

// Packed RGB of every point. Photo colours hold their own light; all others are shaded.
const paint = (mode, about, { count, planes }) => {
  const colors = new Uint32Array(count);
  if (mode.name === "photo") {
    const { green, red_less_green: red, blue_less_green: blue } = planes;
    for (let i = 0; i < count; i++) {
      const g = green[i];
      colors[i] = (((red[i] + g) & 255) << 16) | (g << 8) | ((blue[i] + g) & 255);
    }
    for (const { code, color } of mode.entries ?? [])
      planes.evidence.forEach((c, i) => { if (c === code) colors[i] = hex(color); });
    return colors;
  }
  const table = new Uint32Array(256).fill(hex(mode.other.color)), plane = planes[mode.name];
  mode.entries.forEach((entry) => { table[entry.code] = hex(entry.color); });
  // Along a ramp brightness means something: shade it less.
  const least = mode.ramp ? 0.5 : 0;
  // A mesh gets its light as it turns.
  const shade = (i) => planes.shade ? least + (1 - least) * planes.shade[i] / about.levels : 1;
  for (let i = 0; i < count; i++) colors[i] = dimmed(table[plane[i]], shade(i));
  return colors;
};

const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
const scaled = (a, s) => a.map((x) => x * s);
const plus = (a, b) => a.map((x, k) => x + b[k]);
const minus = (a, b) => a.map((x, k) => x - b[k]);
const norm = (a) => Math.hypot(...a);
const toward = (azimuth, elevation) =>
  [Math.cos(azimuth) * Math.cos(elevation), Math.sin(azimuth) * Math.cos(elevation), Math.sin(elevation)];

// Eye, target and up so that the points in the box fill a picture of that aspect (width over height).
const firstCamera = (about, positions, aspect) => {
  const { low, high } = about, middle = scaled(plus(low, high), 0.5), azimuth = about.azimuth * Math.PI / 180;
  const away = toward(azimuth, about.elevation * Math.PI / 180);
  const right = [-Math.sin(azimuth), Math.cos(azimuth), 0], up = cross(away, right);
  const slope = Math.tan(FIELD_OF_VIEW * Math.PI / 360);
  let distance = 0;
  const every = 3 * Math.ceil(positions.length / 30000);
  for (let i = 0; i < positions.length; i += every) {
    const point = [positions[i], positions[i + 1], positions[i + 2]];
    if (point.some((x, k) => x < low[k] || x > high[k])) continue;
    const along = (axis) => axis.reduce((sum, a, k) => sum + a * (point[k] - middle[k]), 0);
    const wide = Math.max(Math.abs(along(right)) / aspect, Math.abs(along(up)));
    distance = Math.max(distance, along(away) + 1.1 * wide / slope);
  }
  return [...plus(middle, scaled(away, distance)), ...middle, 0, 0, 1];
};

class View {
  constructor(section) {
    this.section = section;
    this.stage = section.querySelector(".view-stage");
    this.about = JSON.parse(section.querySelector(".about").textContent);
    this.legend = section.querySelector(".view-legend");
    this.output = section.querySelector("output");
    this.marks = section.querySelector(".marks");
    // By what is pressed: how many points it takes.
    this.tools = new Map([[section.querySelector(".measure"), 2], [section.querySelector(".facade"), 3]]);
    this.command = section.querySelector(".command");
    this.picked = [];
    this.camera = null;
    this.plot = null;
    // Until the view is drawn, a picture of the page stands in its place.
    const picture = section.parentElement.querySelector(".after img, .sheet img");
    if (picture) this.stage.prepend(Object.assign(picture.cloneNode(), { className: "poster" }));
    this.listen();
  }

  get shown() { return this.section.querySelector(".when input:checked").value; }
  get mode() {
    const name = this.section.querySelector(".colour input:checked").value;
    return this.modes.find((mode) => mode.name === name);
  }
  get modes() { return (this.shown === "surface" ? this.about.surface : this.about).modes; }
  get measuring() { return [...this.tools.keys()].find((tool) => tool.getAttribute("aria-pressed") === "true"); }

  async start() {
    if (this.starting) return;
    this.starting = true;
    try {
      this.data ??= decode(this.about, await inflate(this.section.querySelector(".points").textContent));
      const { K3D, ThreeJsProvider } = await library();
      if (!this.starting) return;
      while (live.length >= MOST_LIVE) live[0].stop();
      live.push(this);
      this.canvas = this.stage.insertBefore(document.createElement("div"), this.stage.firstChild);
      this.canvas.className = "view-canvas";
      this.plot = new K3D(ThreeJsProvider, this.canvas, {
        menuVisibility: false, gridVisible: false, gridAutoFit: false, cameraAutoFit: false, axesHelper: 0,
        grid: [...this.about.corner, ...scaled(this.about.corner, -1)],
        cameraMode: "orbit", cameraUpAxis: "z", cameraFov: FIELD_OF_VIEW, clearColor: 0xf7f8f9, antialias: 1,
      });
      this.plot.on(this.plot.events.RENDERED, () => this.drawMarks());
      await this.show();
      if (!this.plot) return;
      this.plot.setCamera(this.camera ?? this.home());
      this.plot.render();
      this.section.dataset.state = "ready";
    } catch (error) {
      this.fail(error);
    }
  }

  stop() {
    live.splice(live.indexOf(this), 1);
    this.camera = this.plot?.getWorld().controls.getCameraArray() ?? null;
    this.plot?.disable();
    this.canvas?.remove();
    this.plot = null;
    this.starting = false;
    this.section.dataset.state = "stopped";
  }

  fail(error) {
    const note = this.section.querySelector(".view-note");
    note.textContent = `The 3D view cannot be shown (${error?.message ?? error}). It needs a browser with WebGL 2; `
      + "the pictures of this page show the same from fixed sides.";
    this.section.dataset.state = "failed";
    if (this.plot) this.stop();
    this.starting = true;
  }

  home() { return firstCamera(this.about, this.data.positions, this.stage.clientWidth / this.stage.clientHeight); }

  // What is chosen in the chosen colours.
  async show() {
    this.offer();
    this.describe();
    if (!this.plot) return;
    const objects = this.shown === "surface" ? await this.triangles() : [this.points()];
    for (const id of [1, 2]) if (this.plot.getWorld().ObjectsById[id]) this.plot.removeObject(id);
    await this.plot.load({ objects });
    this.plot.render();
  }

  // Only the colours that what is shown has.
  offer() {
    const inputs = [...this.section.querySelectorAll(".colour input")];
    const has = (input) => this.modes.some((mode) => mode.name === input.value);
    inputs.forEach((input) => { input.parentElement.hidden = !has(input); });
    if (!this.mode) inputs.find(has).checked = true;
  }

  // The mesh as K3D takes it: under photos, which hold their own light, what is bridged is an object of one colour.
  async triangles() {
    const { section, about, mode } = this, text = (name) => section.querySelector(name).textContent;
    this.mesh ??= decodeMesh(about.surface, await inflate(text(".triangles")), unpack(text(".picture")));
    const { count, positions, indices, uvs, planes, picture } = this.mesh;
    const array = (values, width) => ({ data: values, shape: width > 1 ? [values.length / width, width] : [values.length] });
    const part = (id, corners, looks) => ({
      id, type: "Mesh", visible: true, opacity: 1, side: "double", color: 0xffffff, model_matrix: UNMOVED,
      vertices: array(positions, 3), indices: array(corners, 3), ...looks,
    });
    if (mode.name !== "photo" || !uvs) return [part(1, indices, { colors: array(paint(mode, about, this.mesh), 1) })];
    const tint = mode.entries[0], of = (bridged) => indices.filter((_, k) =>
      (planes.evidence[indices[k - k % 3]] === tint?.code) === bridged);
    const looks = { color: 0, emissive: 0xffffff, uvs: array(uvs, 2), emissive_map: array(picture, 1) };
    const photos = part(1, of(false), looks);
    return tint ? [photos, part(2, of(true), { color: 0, emissive: hex(tint.color) })] : [photos];
  }

  points() {
    const { data, shown, mode } = this, [from, to] = data.runs[shown];
    this.colors = this.painted === mode.name ? this.colors : paint(mode, this.about, data);
    this.painted = mode.name;
    const array = (values, width) => ({ data: values, shape: width > 1 ? [to - from, width] : [to - from] });
    return {
      id: 1, type: "Points", shader: "flat", visible: true, opacity: 1, point_size: 1,
      positions: array(data.positions.subarray(3 * from, 3 * to), 3),
      colors: array(this.colors.subarray(from, to), 1),
      point_sizes: array(data.diameters[shown].subarray(from, to), 1),
      model_matrix: UNMOVED,
    };
  }

  describe() {
    const { about, mode, legend, shown } = this;
    legend.replaceChildren();
    const entry = (color, text) => {
      const item = document.createElement("span"), dot = document.createElement("i");
      dot.style.background = color;
      item.append(dot, text);
      legend.append(item);
    };
    if (mode.label) legend.append(mode.label);
    if (mode.ramp) {
      const item = document.createElement("span"), ramp = document.createElement("i");
      ramp.className = "ramp";
      ramp.style.background = `linear-gradient(90deg, ${mode.ramp.join(", ")})`;
      item.append(mode.low, ramp, mode.high);
      legend.append(item);
      entry(mode.other.color, mode.other.label);
    } else mode.entries?.filter((e) => e.when.includes(shown)).forEach((e) => entry(e.color, e.label));
    if (shown === "surface") legend.append("Holes are left open: nothing was measured there");
    const count = document.createElement("span"), [from, to] = this.data.runs[shown];
    const [held, all, what] = shown === "surface" ? [about.surface.faces, about.surface.all_faces, "triangles"]
      : [to - from, about.total[shown], "points"];
    count.className = "count";
    count.textContent = `${held < all ? `${held.toLocaleString("en")} of ` : ""}${all.toLocaleString("en")} ${what}`;
    legend.append(count);
  }

  // Projection of the camera, column by column as WebGL has it, and the stage's size.
  projection() {
    const { camera } = this.plot.getWorld();
    camera.updateMatrixWorld();
    const p = camera.projectionMatrix.elements, v = camera.matrixWorldInverse.elements, m = new Float64Array(16);
    for (let c = 0; c < 4; c++) for (let r = 0; r < 4; r++)
      for (let k = 0; k < 4; k++) m[4 * c + r] += p[4 * k + r] * v[4 * c + k];
    const { clientWidth: wide, clientHeight: high } = this.stage;
    return { m, wide, high, focal: p[5] * high / 2 };
  }

  // The point whose disc is drawn at a pixel of the stage, else the nearest within `reach` pixels, else null.
  pick(x, y, reach = 12) {
    const { m, wide, high, focal } = this.projection(), { positions, diameters, runs } = this.data;
    const sizes = diameters[this.shown], [from, to] = runs[this.shown];
    let front = Infinity, hit = -1, nearest = reach * reach, beside = -1;
    for (let i = from; i < to; i++) {
      const px = positions[3 * i], py = positions[3 * i + 1], pz = positions[3 * i + 2];
      const w = m[3] * px + m[7] * py + m[11] * pz + m[15];
      if (w <= 0) continue;
      const u = ((m[0] * px + m[4] * py + m[8] * pz + m[12]) / w * 0.5 + 0.5) * wide - x;
      const v = (0.5 - (m[1] * px + m[5] * py + m[9] * pz + m[13]) / w * 0.5) * high - y;
      const off = u * u + v * v, radius = sizes[i] / 2, disc = (radius * focal / w) ** 2;
      if (off <= disc) {
        const depth = w - radius * Math.sqrt(1 - off / disc);
        if (depth < front) { front = depth; hit = i; }
      } else if (off < nearest) { nearest = off; beside = i; }
    }
    const found = hit >= 0 ? hit : beside;
    if (found < 0) return null;
    return Object.assign(Array.from(positions.subarray(3 * found, 3 * found + 3)), { deviation: this.deviation(found) });
  }

  // Standard deviation of a point; 0 where it is not known.
  deviation(point) {
    const level = this.data.planes.deviation?.[point], [low, high] = this.about.deviation ?? [];
    return level ? low * (high / low) ** ((level - 1) / (this.about.levels - 1)) : 0;
  }

  measure(x, y) {
    const point = this.pick(x, y);
    if (!point) { this.output.textContent = "No point there."; return; }
    const wanted = this.tools.get(this.measuring);
    this.picked = this.picked.length < wanted ? [...this.picked, point] : [point];
    const left = wanted - this.picked.length;
    this.command.hidden = wanted < 3 || left > 0;
    if (left) this.output.textContent = left > 1 ? "Now two more." : "Now one more.";
    else if (wanted === 2) this.output.textContent = this.distance();
    else this.facade();
    this.drawMarks();
  }

  // The command that draws the plane through the picked points.
  facade() {
    const { name, middle } = this.about.surface;
    const places = this.picked.map((point) => middle.map((along, axis) => along + point[axis]));
    const numbers = places.flat().map((x) => Number(x.toFixed(6))).join(" ");
    this.command.textContent = `scenefuse export --what drawings --object ${name} --facade ${numbers}`;
    this.output.textContent = "Below is the command that draws it, in the project's folder.";
  }

  distance() {
    // One standard deviation: of both ends, as far as it is known, of the scale, and of positions as this page holds them.
    const length = norm(minus(...this.picked));
    const known = Math.hypot(...this.picked.map((point) => point.deviation), this.about.scale_sd * length);
    const spread = Math.hypot(known, norm(this.about.step) / Math.sqrt(6));
    const decimals = Math.max(0, 1 - Math.floor(Math.log10(spread)));
    if (!known) return `${Number(Number(length.toPrecision(4)).toFixed(Math.max(0, decimals - 1)))} ${this.about.unit}`;
    const more = this.picked.every((point) => point.deviation) ? "" : " or more";
    return `${length.toFixed(decimals)} ± ${spread.toFixed(decimals)} ${this.about.unit}${more}`;
  }

  drawMarks() {
    if (!this.plot || (!this.picked.length && !this.marks.childNodes.length)) return;
    const { m, wide, high } = this.projection();
    const draw = (name, attributes, text) => {
      const node = document.createElementNS("http://www.w3.org/2000/svg", name);
      for (const [key, value] of Object.entries(attributes)) node.setAttribute(key, value);
      if (text) node.textContent = text;
      return node;
    };
    const seen = this.picked.map(([x, y, z]) => {
      const w = m[3] * x + m[7] * y + m[11] * z + m[15];
      return w <= 0 ? null : [((m[0] * x + m[4] * y + m[8] * z + m[12]) / w * 0.5 + 0.5) * wide,
        (0.5 - (m[1] * x + m[5] * y + m[9] * z + m[13]) / w * 0.5) * high];
    });
    const nodes = [], [a, b] = seen;
    const measured = seen.length === 2 && a && b && this.tools.get(this.measuring) === 2;
    if (measured) {
      const ends = { x1: a[0], y1: a[1], x2: b[0], y2: b[1] };
      nodes.push(draw("line", ends), draw("line", ends));
    }
    seen.filter(Boolean).forEach(([cx, cy]) => nodes.push(draw("circle", { cx, cy, r: 5 })));
    if (measured) nodes.push(draw("text", { x: (a[0] + b[0]) / 2, y: (a[1] + b[1]) / 2 - 8 }, this.distance()));
    this.marks.replaceChildren(...nodes);
  }

  // With one of the tools, or none.
  setMeasuring(chosen) {
    for (const tool of this.tools.keys()) tool.setAttribute("aria-pressed", tool === chosen);
    this.stage.classList.toggle("measuring", Boolean(chosen));
    this.picked = [];
    this.command.hidden = true;
    this.output.textContent = { 2: "Click two points.", 3: "Click three points of it, far apart." }[this.tools.get(chosen)] ?? "";
    this.drawMarks();
  }

  // Turn about the target by angles, or come nearer by a factor.
  move(turn, tilt, nearer) {
    const [ex, ey, ez, ...rest] = this.plot.getWorld().controls.getCameraArray(), target = rest.slice(0, 3);
    const [x, y, z] = minus([ex, ey, ez], target), flat = Math.hypot(x, y), far = Math.hypot(flat, z) / nearer;
    const azimuth = Math.atan2(y, x) + turn;
    const elevation = Math.min(1.55, Math.max(-1.55, Math.atan2(z, flat) + tilt));
    this.plot.setCamera([...plus(target, scaled(toward(azimuth, elevation), far)), ...target, 0, 0, 1]);
    this.plot.render();
  }

  // Turn about a point from now on.
  center(point) {
    const camera = this.plot.getWorld().controls.getCameraArray();
    this.plot.setCamera([...camera.slice(0, 3), ...point, 0, 0, 1]);
    this.plot.render();
  }

  key(event) {
    const step = 0.12, moves = {
      ArrowLeft: [-step, 0, 1], ArrowRight: [step, 0, 1], ArrowUp: [0, step, 1], ArrowDown: [0, -step, 1],
      "+": [0, 0, 1.15], "=": [0, 0, 1.15], "-": [0, 0, 1 / 1.15],
    };
    if (!this.plot || event.ctrlKey || event.metaKey || event.altKey) return;
    if (moves[event.key]) this.move(...moves[event.key]);
    else if (event.key === "Enter" && this.measuring)
      this.measure(this.stage.clientWidth / 2, this.stage.clientHeight / 2);
    else if (event.key === "Escape" && this.measuring) this.setMeasuring(null);
    else return;
    event.preventDefault();
  }

  listen() {
    const { section, stage, tools } = this;
    section.querySelectorAll("input").forEach((input) => input.addEventListener("change", () => this.show()));
    for (const tool of tools.keys())
      tool.addEventListener("click", () => this.setMeasuring(tool === this.measuring ? null : tool));
    section.querySelector(".home").addEventListener("click", () => {
      this.plot?.setCamera(this.home());
      this.plot?.render();
    });
    const full = section.querySelector(".full");
    full.hidden = !document.fullscreenEnabled;
    full.addEventListener("click", () => document.fullscreenElement ? document.exitFullscreen()
      : section.requestFullscreen());
    stage.addEventListener("keydown", (event) => this.key(event));
    // Under a finger the page scrolls until the view is tapped, and again once something else is touched.
    stage.querySelector(".wake").addEventListener("click", () => { stage.classList.add("awake"); stage.focus({ preventScroll: true }); });
    document.addEventListener("pointerdown", (event) => {
      if (!section.contains(event.target)) stage.classList.remove("awake");
    });
    // The wheel scrolls the page until the view is in use.
    stage.addEventListener("wheel", (event) => {
      if (!stage.contains(document.activeElement)) event.stopPropagation();
    }, { capture: true });
    let down = null;
    stage.addEventListener("pointerdown", (event) => {
      stage.focus({ preventScroll: true });
      down = event.isPrimary ? [event.clientX, event.clientY] : null;
    }, { capture: true });
    stage.addEventListener("dblclick", (event) => {
      if (this.measuring || !this.plot) return;
      const box = stage.getBoundingClientRect(), point = this.pick(event.clientX - box.left, event.clientY - box.top);
      if (point) this.center(point);
    });
    stage.addEventListener("pointerup", (event) => {
      const still = down && Math.hypot(event.clientX - down[0], event.clientY - down[1]) < 6;
      down = null;
      if (!still || !this.plot || !this.measuring || event.button !== 0) return;
      const box = stage.getBoundingClientRect();
      this.measure(event.clientX - box.left, event.clientY - box.top);
    }, { capture: true });
  }
}

const views = new Map([...document.querySelectorAll(".view")].map((section) => [section, new View(section)]));
const near = new IntersectionObserver((entries) => {
  for (const { isIntersecting, target } of entries)
    if (isIntersecting) views.get(target).start();
    else target.querySelector(".view-stage").classList.remove("awake");
}, { rootMargin: "300px" });
views.forEach((_view, section) => near.observe(section));
