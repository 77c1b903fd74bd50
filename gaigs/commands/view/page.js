// The page of the viewer: one section a run, a transmitter and a camera for all.
"use strict";

const ORANGE = [0.835, 0.369, 0], GREEN = [0, 0.62, 0.45], BLUE = [0, 0.447, 0.698], PURPLE = [0.42, 0.32, 0.64];

const state = {place: null, receiver: 0, stand: null, height: 0, camera: null, picked: null, since: 0};  // since: time of the last move
// What tests and benchmarks read: times from a drag to its picture [ms], and how many pictures were drawn.
const viewer = window.viewer = {state, runs: [], latencies: [], pictures: 0, ready: false};

const $ = id => document.getElementById(id);
const element = (tag, attributes = {}, ...children) => {
  const made = Object.assign(document.createElement(tag), attributes);
  made.append(...children);
  return made;
};
const flat = lists => lists.flat();
const digits = x => x === 0 ? "0" : Math.abs(x) >= 100 ? x.toFixed(0) : Math.abs(x) >= 10 ? x.toFixed(1)
  : Math.abs(x) >= 1 ? x.toFixed(2) : x.toPrecision(2);
const withUnit = (value, title) => {  // "error [dB]" is the title of "2.1 dB"
  const unit = /\[(.*)\]/.exec(title);
  return minus(digits(value)) + (unit ? ` ${unit[1]}` : "");
};
const short = name => name.length > 16 ? `${name.slice(0, 7)}\u2026${name.slice(-7)}` : name;  // both ends tell apart
const nameOf = title => title.replace(/ \[.*/, "");
const minus = text => String(text).replace("-", "\u2212");
const steps = (low, high, most) => {  // round numbers, by 1, 2 or 5
  const least = (high - low) / most || 1, power = 10 ** Math.floor(Math.log10(least));
  const step = [1, 2, 5, 10].map(k => k * power).find(s => s >= least * 0.999);
  const ticks = [];
  for (let k = Math.ceil(low / step - 1e-9); k <= high / step + 1e-9; k++) ticks.push(+(k * step).toPrecision(12));
  return ticks;
};

const middle = (values, share) => {  // quantiles that leave out a share at both ends
  const order = values.slice().sort((a, b) => a - b), at = share => order[Math.round(share * (order.length - 1))];
  return [at(share), at(1 - share)];
};

const decoded = image => {  // bytes, stored as changes from pixel to pixel
  if (!image || image.values) return image;
  const changes = atob(image.changes);
  image.values = new Uint8Array(changes.length);
  for (let k = 0, level = 0; k < changes.length; k++) image.values[k] = level = (level + changes.charCodeAt(k)) & 255;
  return image;
};

async function unpacked(text) {
  const bytes = Uint8Array.from(atob(text), c => c.charCodeAt(0));
  const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("gzip"));
  return JSON.parse(await new Response(stream).text());
}

// --- where predictions come from: the server, or those stored in the file ---

class Served {
  async get(path, asked) {
    const answer = await (await fetch(`${path}?${new URLSearchParams(asked)}`)).json();
    if (answer.error) throw new Error(answer.error);
    return answer;
  }
  snap(place) { return place; }
  get at() { return state.stand ? {at: state.stand.join()} : {}; }  // of a receiver that stands elsewhere
  answer(run, place, receiver) { return this.get("answer", {run, place: place.join(), receiver, ...this.at}); }
  slice(run, height, receiver) { return this.get("slice", {run, height, receiver, ...this.at}); }
  comparison(run, number) { return this.get("comparison", {run, number}); }
}

class Stored {
  constructor(stored) { this.stored = stored; }
  nearest(values, away) { return values.reduce((best, value, k) => away(value) < away(values[best]) ? k : best, 0); }
  number(place) {
    const places = this.stored.places, z = places[this.nearest(places, p => Math.abs(p[2] - place[2]))][2];
    return this.nearest(places, p => Math.hypot(p[0] - place[0], p[1] - place[1], 1e3 * (p[2] - z)));
  }
  snap(place) { return this.stored.places[this.number(place)]; }
  async answer(run, place, receiver) { return this.stored.runs[run].answers[this.number(place)][receiver]; }
  async slice(run, height, receiver) {
    return this.stored.runs[run].maps[this.nearest(this.stored.heights, z => Math.abs(z - height))][receiver];
  }
  async comparison(run, number) { return this.stored.runs[run].links[number]; }
}

// --- one run ---

class Run {
  constructor(facts, number, content, source) {
    Object.assign(this, {facts, number, source, colours: content.colours});
    this.canvas = element("canvas");
    this.labels = element("div", {className: "labels"});
    this.legend = element("details", {className: "legend"});
    const about = facts.kind ? `${facts.task}, ${facts.receivers.length} receiver${facts.receivers.length > 1 ? "s" : ""}` : facts.task;
    const title = element("h2", {}, facts.title + " ", element("small", {textContent: about + (facts.carrier ? `, predictions at ${+(facts.carrier / 1e9).toPrecision(5)} GHz` : "")}));
    this.scene = element("div", {className: "scene"}, this.canvas, this.labels, this.legend, title);
    this.prediction = element("div"); this.comparison = element("div");
    this.results = element("div", {className: "results"}, this.prediction, this.comparison);
    $("runs").append(element("section", {}, this.scene, this.results));
    this.texts = [];
    this.reset();
  }
  get extent() { return Math.hypot(...this.low.map((x, k) => this.high[k] - x)); }
  reset() {
    const {facts} = this;
    const points = [...facts.box, ...facts.receivers.map(r => r.place), ...flat(facts.edges)];
    this.low = [0, 1, 2].map(k => Math.min(...points.map(p => p[k])));
    this.high = [0, 1, 2].map(k => Math.max(...points.map(p => p[k])));
  }
  colour(scale, share) {
    const rgb = this.colours[scale][Math.round(255 * Math.min(1, Math.max(0, share || 0)))];
    return rgb.map(x => x / 255);
  }

  start() {
    const {facts} = this, drawing = this.drawing = new Drawing(this.canvas);
    const dot = (p, colour, width, alpha = 1) => [...p, ...p, ...colour, alpha, width];
    const line = (a, b, colour, width, alpha = 1) => [...a, ...b, ...colour, alpha, width];
    Object.assign(this, {dot, line});
    const shown = facts.planes.filter(plane => plane.share >= 0.001);
    drawing.set("sphere", "surface", [], "write");
    drawing.set("grid", "stroke", this.grid(), "test");
    drawing.set("map", "surface", [], "test");
    drawing.set("planes", "surface", flat(shown.map(({corners}) =>
      flat(corners.slice(2).map((c, k) => flat([corners[0], corners[k + 1], c].map(p => [...p, ...BLUE, 0.09])))))), "test");
    for (const [name, splats] of Object.entries(facts.splats)) {
      const order = splats.strengths.slice().sort((a, b) => a - b), highest = order[Math.floor(0.98 * order.length)] || 1;
      this.highest = {...this.highest, [name]: highest};
      drawing.set(name, "splat", flat(splats.means.map((p, k) => [...p, ...splats.covariances[k],
        ...(name === "obstacles" ? PURPLE : this.colour("Blues", 0.3 + 0.7 * splats.strengths[k] / highest)),
        splats.opacities[k]])), "test");
    }
    drawing.set("edges", "stroke", flat(facts.edges.map(([a, b]) => line(a, b, [0.5, 0.5, 0.5], 1.3))), "test");
    drawing.set("outlines", "stroke", flat(shown.map(({corners, share}) => flat(corners.map((c, k) =>
      line(c, corners[(k + 1) % corners.length], BLUE, 1 + 3 * Math.sqrt(share), 0.6))))), "test");
    drawing.set("places", "stroke", flat(facts.places.map(p => dot(p, [0.45, 0.45, 0.45], 3.5))), "test");
    drawing.set("tests", "stroke", [], "test");
    drawing.set("paths", "stroke", [], "none");
    drawing.set("receivers", "stroke", [], "none");
    drawing.set("transmitter", "stroke", [], "none");
    this.planeTexts = shown.slice(0, 8).map(({corners, number, share}) => {
      const middles = corners.map((c, k) => c.map((x, n) => (x + corners[(k + 1) % corners.length][n]) / 2));
      return {text: `plane ${number}: ${digits(100 * share)} %`, kind: "plane", place: middles.reduce((a, b) => b[2] > a[2] ? b : a)};
    });
    this.drawTests(); this.drawReceivers(); this.drawLegend();
    this.listen();
  }

  grid() {  // of the floor, every round number of metres
    const [low, high] = [this.low, this.high], z = low[2], grey = [0.88, 0.88, 0.88], lines = [];
    const ticks = [0, 1].map(k => steps(low[k], high[k], 8));
    for (const x of ticks[0]) lines.push(this.line([x, low[1], z], [x, high[1], z], grey, 1));
    for (const y of ticks[1]) lines.push(this.line([low[0], y, z], [high[0], y, z], grey, 1));
    const away = 0.035 * this.extent;
    this.gridTexts = [
      ...ticks[0].map(x => ({text: minus(x), place: [x, low[1] - away, z]})),
      ...ticks[1].map(y => ({text: minus(y), place: [high[0] + away, y, z]})),
      {text: "x [m]", place: [(low[0] + high[0]) / 2, low[1] - 2.6 * away, z]},
      {text: "y [m]", place: [high[0] + 2.6 * away, (low[1] + high[1]) / 2, z]}];
    return flat(lines);
  }

  drawReceivers() {
    const numbers = [];
    this.facts.receivers.forEach((receiver, k) => {
      const own = k === state.receiver;
      numbers.push(...this.dot(receiver.place, [1, 1, 1], own ? 15 : 11), ...this.dot(receiver.place, GREEN, own ? 12 : 8, own ? 1 : 0.7));
    });
    this.drawing.set("receivers", "stroke", numbers, "none");
  }

  drawTests() {
    const {tests} = this.facts;
    if (!tests) return;
    const alike = viewer.runs.map(run => run.facts.tests).filter(other => other && other.title === tests.title);
    this.ends = middle(alike.flatMap(other => other.scores), 0.05);
    const numbers = [];
    tests.places.forEach((p, k) => {
      if (tests.receivers[k] !== state.receiver) return;
      const picked = state.picked && state.picked.run === this.number && state.picked.number === k;
      numbers.push(...this.dot(p, picked ? ORANGE : [0.35, 0.35, 0.35], picked ? 16 : 10), ...this.dot(p, this.errorColour(tests.scores[k]), 8.5));
    });
    this.drawing.set("tests", "stroke", numbers, "test");
  }
  errorColour(score) {
    const [low, high] = this.ends, share = high > low ? (score - low) / (high - low) : 0;
    return this.colour("YlOrRd", this.facts.tests.rises ? 1 - share : share);
  }

  drawMap({x, y, height, values}, range) {
    const [low, high] = this.range = range;
    this.level = height;
    const corner = (i, j) => [x[i], y[j], height,
      ...this.colour("viridis", (values[j * x.length + i] - low) / (high - low || 1)), 0.8];
    const numbers = [];
    for (let j = 0; j + 1 < y.length; j++) for (let i = 0; i + 1 < x.length; i++)
      for (const [a, b] of [[0, 0], [1, 0], [1, 1], [0, 0], [1, 1], [0, 1]]) numbers.push(...corner(i + a, j + b));
    this.drawing.set("map", "surface", numbers, "test");
    this.drawLegend();
  }

  drawSphere(image) {  // a spectrum in the receiver's directions
    const {facts} = this, receiver = facts.receivers[state.receiver], radius = 0.085 * this.extent;
    const every = (list, by) => list.filter((_, k) => k % by === 0), table = this.colours.viridis;
    const rows = every(facts.elevations, image.step), columns = every(facts.azimuths, image.step);
    const thin = Math.ceil(Math.sqrt(rows.length * columns.length / 5000));
    const up = every([...rows.keys()], thin), across = every([...columns.keys()], thin);
    const angles = across.map(j => columns[j] * Math.PI / 180), pitch = 1.5 * thin * Math.abs(columns[1] - columns[0]);
    const whole = Math.abs(columns[columns.length - 1] - columns[0]) + pitch >= 360, count = across.length - (whole ? 0 : 1);
    const numbers = new Float32Array(42 * (up.length - 1) * count);
    let end = 0;
    const corner = (i, j) => {
      const elevation = rows[up[i]] * Math.PI / 180, level = Math.cos(elevation);
      const local = [level * Math.cos(angles[j]), level * Math.sin(angles[j]), Math.sin(elevation)];
      for (let k = 0; k < 3; k++) numbers[end++] = receiver.place[k] + radius
        * (local[0] * receiver.axes[0][k] + local[1] * receiver.axes[1][k] + local[2] * receiver.axes[2][k]);
      const colour = table[image.values[up[i] * columns.length + across[j]]];
      for (let k = 0; k < 3; k++) numbers[end++] = colour[k] / 255;
      numbers[end++] = 1;
    };
    for (let i = 0; i + 1 < up.length; i++) for (let j = 0; j < count; j++) {
      const next = (j + 1) % across.length;
      corner(i, j); corner(i, next); corner(i + 1, next); corner(i, j); corner(i + 1, next); corner(i + 1, j);
    }
    this.drawing.set("sphere", "surface", numbers, "write");
  }

  drawAnswer(answer) {
    this.place = answer.place;
    const numbers = [];
    for (const {points, power} of answer.paths.slice().reverse()) {
      const colour = this.colour("plasma_r", 0.12 + 0.88 * (1 + power / 30));
      points.slice(1).forEach((p, k) => numbers.push(...this.line(points[k], p, colour, 1.2 + 3 * (1 + power / 30))));
    }
    this.drawing.set("paths", "stroke", numbers, "none");
    this.drawing.set("transmitter", "stroke", [...this.line(answer.place, [answer.place[0], answer.place[1], this.low[2]], ORANGE, 1.5, 0.6),
      ...this.dot(answer.place, [1, 1, 1], 21), ...this.dot(answer.place, ORANGE, 17)], "none");
    if (decoded(answer.image)) this.drawSphere(answer.image);
    const {facts} = this, parts = [element("h3", {textContent: "Prediction"})];
    if (answer.image) {
      parts.push(element("p", {textContent: `amplitude at ${facts.receivers[state.receiver].name}`}), this.plotImage(answer.image, "viridis", 1));
      if (decoded(answer.std)) {
        const mean = answer.std.values.reduce((a, b) => a + b, 0) / answer.std.values.length / 255;
        parts.push(element("p", {textContent: `standard deviation, mean ${digits(mean)}`}), this.plotImage(answer.std, "YlOrRd", 0.3));
      }
    }
    if (answer.levels) parts.push(this.plotLevels(answer));
    if (answer.curves) {
      parts.push(element("p", {textContent: minus(`power ${digits(answer.level)} dB`) + (answer.std === null ? "" :
        `; standard deviation ${minus(digits(answer.std))} dB, expected SNR ${minus(digits(answer.snr))} dB`)}), this.plotCurves(answer.curves));
    }
    if (answer.paths.length) parts.push(element("p", {textContent: `${answer.paths.length} paths within 30 dB of the strongest`}));
    if (!facts.kind) parts.push(element("p", {textContent: `labels of task ${facts.task} have no picture here`}));
    this.prediction.replaceChildren(...parts);
  }

  drawComparison(found, number) {
    const {facts} = this, score = `${nameOf(facts.tests.title)} ${withUnit(facts.tests.scores[number], facts.tests.title)}`;
    const parts = [element("h3", {textContent: `Test link ${number + 1}: ${score}`})];
    const name = facts.receivers[facts.tests.receivers[number]].name;
    if (found.curves) parts.push(this.plotCurves(found.curves));
    else if (facts.kind === "level") {
      const [measured, predicted] = [found.label, found.prediction].map(x => withUnit(x, facts.quantity));
      parts.push(element("p", {textContent: `${nameOf(facts.quantity)} at ${name}: measured ${measured}, predicted ${predicted}`}));
    } else if (found.label) parts.push(
      element("p", {textContent: "measured"}), this.plotImage(found.label, "viridis", 1),
      element("p", {textContent: "predicted"}), this.plotImage(found.prediction, "viridis", 1));
    this.comparison.replaceChildren(...parts);
  }

  // --- flat plots ---

  paper(width, height) {
    const canvas = element("canvas"), ratio = 2, pen = canvas.getContext("2d");
    [canvas.width, canvas.height] = [ratio * width, ratio * height];
    pen.scale(ratio, ratio); pen.font = "11px system-ui, sans-serif"; pen.fillStyle = "#444"; pen.strokeStyle = "#bbb";
    return [canvas, pen];
  }

  plotImage(image, scale, highest) {
    const {facts} = this, columns = decoded(image).values.length / image.rows, width = 370, inner = [34, 4, width - 82, 80];
    const [canvas, pen] = this.paper(width, 114), source = element("canvas", {width: columns, height: image.rows});
    const pixels = new ImageData(columns, image.rows), rises = facts.elevations[0] < facts.elevations[facts.elevations.length - 1];
    const table = this.colours[scale], words = new Uint32Array(pixels.data.buffer);
    const packed = table.map(([r, g, b]) => (255 << 24 | b << 16 | g << 8 | r) >>> 0);
    for (let i = 0, k = 0; i < image.rows; i++) for (let j = 0; j < columns; j++, k++)
      words[k] = packed[Math.min(255, Math.round(image.values[(rises ? image.rows - 1 - i : i) * columns + j] / highest))];
    source.getContext("2d").putImageData(pixels, 0, 0);
    const [x, y, w, h] = inner;
    pen.drawImage(source, x, y, w, h);
    const span = list => [Math.min(list[0], list[list.length - 1]), Math.max(list[0], list[list.length - 1])];
    const [az, el] = [span(facts.azimuths), span(facts.elevations)];
    pen.textAlign = "center";
    for (let a = Math.ceil(az[0] / 90) * 90; a <= az[1] + 1; a += 90) pen.fillText(`${minus(a)}°`, x + w * (a - az[0]) / (az[1] - az[0]), y + h + 13);
    pen.fillText("azimuth", x + w / 2, y + h + 26);
    pen.textAlign = "right";
    for (let e = Math.ceil(el[0] / 30) * 30; e <= el[1]; e += 30) pen.fillText(`${minus(e)}°`, x - 3, y + h - h * (e - el[0]) / (el[1] - el[0]) + 4);
    pen.save(); pen.translate(9, y + h / 2); pen.rotate(-Math.PI / 2); pen.textAlign = "center"; pen.fillText("elevation", 0, 0); pen.restore();
    for (let k = 0; k < h; k++) { pen.fillStyle = `rgb(${table[Math.round(255 * (1 - k / h))]})`; pen.fillRect(x + w + 10, y + k, 9, 1.5); }
    pen.fillStyle = "#444"; pen.textAlign = "left";
    for (const share of [0, 0.5, 1]) pen.fillText(digits(share * highest), x + w + 22, y + 8 + (h - 8) * (1 - share));
    return canvas;
  }

  plotLevels(answer) {
    const {facts} = this, row = 24, width = 370, left = 92, right = 96, all = answer.levels.map((v, k) => k);
    const others = all.filter(k => k !== state.receiver).sort((a, b) => answer.levels[b] - answer.levels[a]);
    const shown = all.length > 16 ? [state.receiver, ...others.slice(0, 15)] : all;  // the chosen one, and the loudest
    const [canvas, pen] = this.paper(width, row * shown.length + 40);
    const stds = answer.stds || answer.levels.map(() => 0);
    const ends = [Math.min(...answer.levels.map((v, k) => v - stds[k])), Math.max(...answer.levels.map((v, k) => v + stds[k]))];
    this.reach = this.reach ? [Math.min(ends[0], this.reach[0]), Math.max(ends[1], this.reach[1])] : ends;
    const ticks = steps(this.reach[0], this.reach[1], 5), gap = (ticks[1] - ticks[0]) || 1;
    const [low, high] = [Math.min(ticks[0], this.reach[0] - gap / 4), Math.max(ticks[ticks.length - 1], this.reach[1] + gap / 4)];
    const at = v => left + (width - left - right) * (v - low) / (high - low), bottom = row * shown.length + 4;
    pen.lineWidth = 1;
    for (const tick of ticks) {
      pen.strokeStyle = "#e4e4e4"; pen.beginPath(); pen.moveTo(at(tick), 2); pen.lineTo(at(tick), bottom); pen.stroke();
      pen.textAlign = "center"; pen.fillText(minus(tick), at(tick), bottom + 13);
    }
    pen.fillText(facts.quantity + (answer.stds ? " ± standard deviation" : ""), (left + width - right) / 2, bottom + 27);
    shown.forEach((k, number) => {
      const y = row * (number + 0.5) + 2, value = answer.levels[k], own = k === state.receiver;
      pen.font = `${own ? "600 " : ""}11px system-ui, sans-serif`;
      pen.textAlign = "right"; pen.fillStyle = own ? "#00664a" : "#444";
      pen.fillText(short(facts.receivers[k].name), left - 8, y + 4, left - 12);
      pen.strokeStyle = pen.fillStyle = own ? "#009e73" : "#6e6e6e"; pen.lineWidth = 2;
      pen.beginPath(); pen.moveTo(at(value - stds[k]), y); pen.lineTo(at(value + stds[k]), y); pen.stroke();
      pen.beginPath(); pen.arc(at(value), y, 4.5, 0, 7); pen.fill();
      pen.textAlign = "left"; pen.fillStyle = "#222";
      pen.fillText(minus(value.toFixed(1)) + (answer.stds ? ` ± ${stds[k].toFixed(1)}` : ""), width - right + 10, y + 4);
    });
    return canvas;
  }

  plotCurves(curves) {
    const names = Object.keys(curves), first = curves[names[0]], width = 370, height = 210, [left, top, w, h] = [40, 18, width - 50, height - 56];
    const [canvas, pen] = this.paper(width, height);
    const peak = Math.max(...names.flatMap(name => curves[name].y)), low = Math.max(peak - 50, Math.min(...names.flatMap(name => curves[name].y)) - 3);
    const ticks = steps(low, peak + 4, 6), xs = first.x, at = (x, y) => [left + w * (x - xs[0]) / (xs[xs.length - 1] - xs[0] || 1), top + h * (peak + 4 - y) / (peak + 4 - low)];
    pen.lineWidth = 1; pen.textAlign = "right"; pen.strokeStyle = "#e4e4e4";
    for (const y of ticks) { pen.beginPath(); pen.moveTo(left, at(xs[0], y)[1]); pen.lineTo(left + w, at(xs[0], y)[1]); pen.stroke(); pen.fillText(minus(y), left - 4, at(xs[0], y)[1] + 4); }
    pen.textAlign = "center";
    for (const x of steps(xs[0], xs[xs.length - 1], 6)) { pen.beginPath(); pen.moveTo(at(x, low)[0], top); pen.lineTo(at(x, low)[0], top + h); pen.stroke(); pen.fillText(minus(x), at(x, low)[0], top + h + 14); }
    pen.fillText(first.xlabel, left + w / 2, top + h + 29);
    pen.textAlign = "left"; pen.fillText(first.ylabel, 4, 10);
    pen.save(); pen.beginPath(); pen.rect(left, top, w, h); pen.clip();
    names.forEach(name => {
      [pen.strokeStyle, pen.lineWidth] = name === "measured" ? ["#1a1a1a", 1] : ["#56b4e9", 2.6];
      pen.beginPath(); curves[name].x.forEach((x, k) => pen.lineTo(...at(x, curves[name].y[k]))); pen.stroke();
    });
    pen.restore();
    if (names.length > 1) names.forEach((name, k) => {
      pen.fillStyle = name === "measured" ? "#1a1a1a" : "#2b8cc4"; pen.textAlign = "right"; pen.fillText(name, left + w - 4, top + 12 + 14 * k);
    });
    return canvas;
  }

  // --- legend, labels and frames ---

  drawLegend() {
    const {facts} = this, gradient = (name, backwards) => `linear-gradient(${backwards ? 270 : 90}deg, ${[0, 51, 102, 153, 204, 255].map(k => `rgb(${this.colours[name][k]})`)})`;
    const layers = [];
    const add = (names, text, swatch, on, scale) => layers.push({names, text, swatch, on, scale});
    if (facts.edges.length) add(["edges"], "true walls and furniture", "height:2px;background:#8c8c8c", true);
    if (facts.planes.length) add(["planes", "outlines"], "learnt walls, with share of power", "background:#0072b222;border:1.5px solid #0072b2", true);
    if (facts.splats.obstacles) add(["obstacles"], "learnt obstacles", "border-radius:5px;background:#6b52a3", true);
    if (facts.splats.gaussians) {
      const {means, total} = facts.splats.gaussians;
      add(["gaussians"], total > means.length ? `Gaussians, ${means.length} strongest of ${total}` : `${total} Gaussians`, `border-radius:5px;background:${gradient("Blues")}`, true,
        ["Blues", "0", `${digits(this.highest.gaussians)} |signal| × opacity`]);
    }
    if (facts.places.length) add(["places"], "transmitters, train", "width:5px;height:5px;margin:auto;border-radius:5px;background:#737373", false);
    if (facts.tests) {
      const [low, high] = this.ends;
      add(["tests"], `test links by ${nameOf(facts.tests.title)}; click one`, "width:9px;height:9px;margin:auto;border-radius:5px;background:#fd8d3c;border:1px solid #555", true,
        ["YlOrRd", minus(digits(low)), withUnit(high, facts.tests.title), facts.tests.rises]);
    }
    if (facts.map) add(["map"], `radio map: ${nameOf(facts.map)}${this.range ? ` at z = ${minus(digits(this.level))} m` : ""}`, `background:${gradient("viridis")}`, true,
      this.range ? ["viridis", minus(digits(this.range[0])), withUnit(this.range[1], facts.map)] : null);
    if (facts.kind === "spectrum") add(["sphere"], "spectrum at the receiver", `border-radius:5px;background:${gradient("viridis")}`, true, ["viridis", "0", "1 amplitude"]);
    if (facts.planes.length) add(["paths"], "paths", "height:3px;background:#9c179e", true, ["plasma_r", minus("-30"), "0 dB of the strongest"]);
    this.legend.replaceChildren(element("summary", {textContent: "legend"}), ...layers.map(({names, text, swatch, on, scale}) => {
      this.drawn = this.drawn || {};
      const is = this.drawn[names[0]] ?? on;
      const box = element("input", {type: "checkbox", checked: is, name: names[0]});
      const show = visible => { this.drawn[names[0]] = visible; for (const name of names) this.drawing.layers.get(name).visible = visible; };
      show(is);
      box.addEventListener("change", () => { show(box.checked); if (names[0] === "map") updateMaps(); redraw(); });
      const mark = element("span", {className: "swatch"}); mark.style.cssText = swatch;
      const row = element("label", {}, box, mark, text);
      if (scale) {
        const bar = element("span", {className: "bar"}); bar.style.background = gradient(scale[0], scale[3]);
        row.append(element("span", {className: "scale"}, scale[1], bar, scale[2]));
      }
      return row;
    }));
  }

  drawFrame() {
    this.drawing.draw(state.camera);
    const {clientWidth: w, clientHeight: h} = this.canvas;
    const texts = [...this.gridTexts, ...(this.drawn.planes ? this.planeTexts : []),
      ...this.facts.receivers.map((r, k) => ({text: r.name, place: r.place, kind: "receiver", up: 16, hidden: this.facts.receivers.length > 12 && k !== state.receiver})),
      ...(this.place ? [{text: "transmitter", place: this.place, kind: "transmitter", up: 20}] : [])].filter(t => !t.hidden);
    while (this.labels.children.length < texts.length) this.labels.append(element("span"));
    [...this.labels.children].forEach((span, k) => {
      const text = texts[k], [x, y, z] = text ? state.camera.project(text.place, w, h) : [0, 0, -1];
      span.hidden = !(z > 0);
      if (span.hidden) return;
      if (span.textContent !== text.text) span.textContent = text.text;
      span.className = text.kind || "";
      span.style.left = `${x}px`; span.style.top = `${y - (text.up || 0)}px`;
    });
  }

  // --- mouse and touch ---

  listen() {
    const canvas = this.canvas, held = new Map();
    let grab = null, moved = 0, pinch = 0;
    const onReceiver = (...spot) => viewer.movable && near(this.facts.receivers[state.receiver].place, ...spot) < 16;
    const at = event => { const box = canvas.getBoundingClientRect(); return [event.clientX - box.left, event.clientY - box.top, box.width, box.height]; };
    const near = (place, x, y, w, h) => { const [px, py, z] = state.camera.project(place, w, h); return z > 0 ? Math.hypot(px - x, py - y) : Infinity; };
    canvas.addEventListener("contextmenu", event => event.preventDefault());
    canvas.addEventListener("pointerdown", event => {
      const [x, y, w, h] = at(event);
      canvas.setPointerCapture(event.pointerId);
      held.set(event.pointerId, [x, y]);
      moved = 0;
      grab = held.size === 1 && event.button === 0 && this.place && near(this.place, x, y, w, h) < 22 ? "transmitter"
        : held.size === 1 && event.button === 0 && onReceiver(x, y, w, h) ? "receiver"
        : held.size > 1 || event.button || event.shiftKey ? "pan" : "turn";
    });
    canvas.addEventListener("pointermove", event => {
      const [x, y, w, h] = at(event), last = held.get(event.pointerId), {camera} = state;
      if (!last) { canvas.style.cursor = this.place && near(this.place, x, y, w, h) < 22 || onReceiver(x, y, w, h) ? "move" : "grab"; return; }
      const [dx, dy] = [x - last[0], y - last[1]];
      held.set(event.pointerId, [x, y]);
      moved += Math.abs(dx) + Math.abs(dy);
      if (grab === "transmitter" || grab === "receiver") {
        const height = grab === "receiver" ? this.facts.receivers[state.receiver].place[2] : state.height;
        const ray = camera.ray(x, y, w, h), eye = camera.eye, t = (height - eye[2]) / ray[2];
        if (!(t > 0)) return;
        const spot = [0, 1].map(k => Math.min(this.high[k], Math.max(this.low[k], eye[k] + t * ray[k]))).concat(height);
        if (grab === "receiver") stand(spot); else move(spot);
        return;
      }
      if (grab === "turn") {
        camera.azimuth -= 0.007 * dx;
        camera.elevation = Math.min(1.55, Math.max(-1.55, camera.elevation + 0.007 * dy));
      } else {
        const scale = camera.distance / (1.3 * h) / held.size, [right, up] = camera.axes;
        camera.target = camera.target.map((t, k) => t - scale * (dx * right[k] - dy * up[k]));
        if (held.size === 2) {
          const [a, b] = [...held.values()], apart = Math.hypot(a[0] - b[0], a[1] - b[1]);
          if (pinch) camera.distance *= pinch / apart;
          pinch = apart;
        }
      }
      redraw();
    });
    const release = event => {
      const [x, y, w, h] = at(event);
      if (event.type === "pointerup" && grab === "turn" && moved < 4) this.pick((place) => near(place, x, y, w, h));
      held.delete(event.pointerId);
      grab = null; pinch = 0;
    };
    canvas.addEventListener("pointerup", release);
    canvas.addEventListener("pointercancel", release);
    canvas.addEventListener("wheel", event => {
      event.preventDefault();
      state.camera.distance *= Math.exp(0.0012 * event.deltaY);
      redraw();
    }, {passive: false});
  }
  pick(away) {
    const {tests} = this.facts;
    if (!tests || !this.drawn.tests) return;
    const own = tests.places.map((place, k) => [k, tests.receivers[k] === state.receiver ? away(place) : Infinity]);
    const [number, distance] = own.reduce((a, b) => b[1] < a[1] ? b : a, [-1, 14]);
    if (number >= 0 && distance < 14) choose(this.number, number);
  }
}

// --- all runs ---

let asked = false, busy = false, frame = 0;

function redraw() {
  if (frame) return;
  frame = requestAnimationFrame(() => { frame = 0; viewer.runs.forEach(run => run.drawFrame()); });
}

function fail(error) {
  $("hint").textContent = error.message;
  $("hint").className = "error";
  console.error(error);
}

function show(place) {
  state.place = place; state.height = place[2];
  $("height").value = place[2];
  $("place").textContent = minus(`(${place.map(x => x.toFixed(2)).join(", ")}) m`);
}

function move(place) {
  const snapped = viewer.source.snap(place), heightChanged = snapped[2] !== state.height;
  if (String(snapped) === String(state.place)) return;
  state.since = performance.now();
  show(snapped);
  update();
  if (heightChanged) updateMaps();
}

// Puts the chosen receiver at a place, or for null back to its own.
function stand(place) {
  state.stand = place;
  state.since = performance.now();
  viewer.runs.forEach(run => {
    const receiver = run.facts.receivers[state.receiver];
    receiver.home = receiver.home || receiver.place;
    receiver.place = place || receiver.home;
    run.drawReceivers();
  });
  $("stand").value = viewer.runs[0].facts.receivers[state.receiver].place.map(x => +x.toFixed(2)).join(", ");
  update(); updateMaps();
}

const painted = () => new Promise(done => requestAnimationFrame(done));

// Answers one place at a time; of the places since then only the last.
async function update() {
  asked = true;
  if (busy) return;
  busy = true;
  try {
    while (asked) {
      asked = false;
      const {since, place, receiver} = state;
      const answers = await Promise.all(viewer.runs.map(run => run.source.answer(run.number, place, receiver)));
      viewer.runs.forEach((run, k) => run.drawAnswer(answers[k]));
      viewer.runs.forEach(run => run.drawFrame());
      await painted();  // the picture is on the screen
      viewer.latencies.push(performance.now() - since);
      viewer.pictures++;
    }
  } catch (error) { fail(error); } finally { busy = false; }
}

let mapsAsked = false, mapsBusy = false;
async function updateMaps() {
  mapsAsked = true;
  if (mapsBusy) return;
  mapsBusy = true;
  try {
    while (mapsAsked) {
      mapsAsked = false;
      const runs = viewer.runs.filter(run => run.facts.map && run.drawn.map);
      const maps = await Promise.all(runs.map(run => run.source.slice(run.number, state.height, state.receiver)));
      runs.forEach((run, k) => {
        const alike = maps.filter((_, other) => runs[other].facts.map === run.facts.map);  // one scale for both
        run.drawMap(maps[k], middle(alike.flatMap(map => map.values), 0.01));
      });
      redraw();
    }
  } catch (error) { fail(error); } finally { mapsBusy = false; }
}

async function choose(run, number) {
  state.picked = {run, number};
  try {
    for (const each of viewer.runs) {
      // Runs of the same links show the same link.
      const {tests} = each.facts, place = viewer.runs[run].facts.tests.places[number];
      const own = each.number === run ? number : tests ? tests.places.findIndex((p, k) => String(p) === String(place) && tests.receivers[k] === state.receiver) : -1;
      if (own >= 0) each.drawComparison(await each.source.comparison(each.number, own), own);
      each.drawTests();
    }
  } catch (error) { fail(error); }
  redraw();
}

async function start() {
  const content = await unpacked($("content").textContent);
  viewer.source = content.stored ? new Stored(content.stored) : new Served();
  viewer.runs = content.runs.map((facts, k) => new Run(facts, k, content, viewer.source));
  $("runs").classList.toggle("two", viewer.runs.length > 1);
  document.title = content.runs.map(run => run.title).join(" | ") + " - gaigs";
  const [first] = viewer.runs, {box, height, receivers} = first.facts;
  viewer.runs.forEach(run => { run.start(); run.legend.open = viewer.runs.length === 1; });
  $("receiver").append(...receivers.map((receiver, k) => element("option", {value: k, textContent: receiver.name})));
  $("receiver").parentElement.hidden = receivers.length < 2;
  $("receiver").addEventListener("change", event => {
    if (state.stand) stand(null);
    state.receiver = +event.target.value;
    viewer.runs.forEach(run => run.drawTests());
    stand(null);
  });
  viewer.movable = !content.stored && content.runs.every(run => run.movable);
  $("stand").parentElement.hidden = !viewer.movable;
  $("stand").value = receivers[0].place.map(x => +x.toFixed(2)).join(", ");
  $("stand").addEventListener("change", event => {
    const place = event.target.value.split(/[\s,;]+/).filter(Boolean).map(Number);
    if (place.length === 3 && place.every(Number.isFinite)) stand(place);
    else if (!place.length) stand(null);
    else fail(new Error("a receiver stands at three numbers: x, y, z [m]"));
  });
  const slider = $("height");
  const heights = content.stored ? content.stored.places.map(place => place[2]) : [first.low[2], first.high[2]];
  [slider.min, slider.max] = [Math.min(...heights), Math.max(...heights)];
  slider.parentElement.hidden = slider.min === slider.max;
  slider.addEventListener("input", () => move([state.place[0], state.place[1], +slider.value]));
  const home = () => {
    const {clientWidth, clientHeight} = first.canvas;
    state.camera = new Camera(first.low, first.high);
    state.camera.distance *= Math.max(1, 1.3 * clientHeight / clientWidth);  // the whole room in a narrow window
    redraw();
  };
  $("reset").addEventListener("click", home);
  $("hint").textContent = `drag the transmitter${viewer.movable ? ", or the receiver" : ""}; elsewhere: turn, right button: shift, wheel: zoom`;
  addEventListener("resize", redraw);
  home();
  show(viewer.source.snap([(box[0][0] + box[1][0]) / 2, (box[0][1] + box[1][1]) / 2, height]));
  await update();
  viewer.ready = true;
  await updateMaps();
}

start().catch(fail);
