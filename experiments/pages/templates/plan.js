// The bound of one epoch over the floor, with anchors and stations that can be dragged.
"use strict";
const data = JSON.parse(document.getElementById("data").textContent);
const element = (id) => document.getElementById(id);
const copy = (value) => JSON.parse(JSON.stringify(value));
let anchors, stations;

function reset() {
  anchors = copy(data.anchors);
  data.proposed.forEach((one) => anchors.push({ ...copy(one), proposed: true }));
  stations = copy(data.stations);
}

// ---- Fisher's information: rows of the whitened Jacobian of one epoch at a point

const minus = (a, b) => a.map((x, k) => x - b[k]);
const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
const scaled = (a, s) => a.map((x) => x * s);
const sum = (a, b) => a.map((x, k) => x + b[k]);

// Times of arrival are known up to an offset that all anchors share: rows less their mean, of half a difference's variance.
function anchorRows(point) {
  const sigma = data.sigmas.difference === null ? data.sigmas.range : data.sigmas.difference / Math.SQRT2;
  const rows = anchors.map((anchor) => {
    const d = minus(point, anchor.position);
    return scaled(d, 1 / (Math.hypot(...d) * sigma));
  });
  if (data.sigmas.difference === null || !rows.length) return rows;
  const mean = scaled(rows.reduce(sum, [0, 0, 0]), 1 / rows.length);
  return rows.map((row) => minus(row, mean));
}

function angleRows(station, point) {
  const d = minus(point, station.position);
  const [x, y, z] = station.axes.map((axis) => dot(axis, d));
  const flat2 = x * x + z * z, flat = Math.sqrt(flat2), all = flat2 + y * y;
  const azimuth = sum(scaled(station.axes[0], z / flat2), scaled(station.axes[2], -x / flat2));
  const elevation = [0, 1, 2].map((k) => (flat * station.axes[1][k]
    - (y / flat) * (x * station.axes[0][k] + z * station.axes[2][k])) / all);
  return [azimuth, elevation].map((row) => scaled(row, 1 / data.sigmas.angle));
}

// A phase is known up to an offset that all antennas share: rows less their mean.
function phaseRows(station, point) {
  const rows = station.antennas.map(([a, b]) => {
    const antenna = sum(station.position, sum(scaled(station.axes[0], a), scaled(station.axes[1], b)));
    const d = minus(point, antenna);
    return scaled(d, 2 * Math.PI / (station.wavelength * Math.hypot(...d) * data.sigmas.phase));
  });
  const mean = scaled(rows.reduce(sum, [0, 0, 0]), 1 / rows.length);
  return rows.map((row) => minus(row, mean));
}

function information(point) {
  const rows = anchorRows(point);
  for (const station of stations) rows.push(...(station.antennas ? phaseRows : angleRows)(station, point));
  const J = [[0, 0, 0], [0, 0, 0], [0, 0, 0]];
  for (const row of rows) for (let i = 0; i < 3; i++) for (let k = 0; k < 3; k++) J[i][k] += row[i] * row[k];
  return J;
}

// Variances by cofactors; NaN where the position is not determined.
function bounds(point) {
  const [[a, b, c], [, d, e], [, , f]] = information(point);
  const flat = a * d - b * b;
  const cofactors = [d * f - e * e, a * f - c * c, flat];
  const all = a * cofactors[0] - b * (b * f - c * e) + c * (b * e - c * d);
  const checked = (variance) => (variance > 0 && variance < data.unlimited ** 2 ? Math.sqrt(variance) : NaN);
  return {
    flat: checked((a + d) / flat),
    horizontal: checked((cofactors[0] + cofactors[1]) / all),
    vertical: checked(cofactors[2] / all),
    spatial: checked((cofactors[0] + cofactors[1] + cofactors[2]) / all),
  };
}

// ---- the map

const heat = element("heat"), marks = element("marks"), cell = data.x[1] - data.x[0];
const left = data.x[0] - cell / 2, top_ = data.y[data.y.length - 1] + cell / 2;
const width = data.x.length * cell, height = data.y.length * cell, margin = 0.08 * Math.max(width, height);
let field = [], computed = null;

const factor = () => (element("unit").value === "cm" ? 100 : 1 / (data.sigmas.difference ?? data.sigmas.range));
const shown = (value) => (Number.isFinite(value) ? (value * factor()).toPrecision(3) : "–") + (element("unit").value === "cm" ? " cm" : "");
const tagHeight = () => Number(element("height").value);

function compute() {
  computed = data.x.map((x, i) => data.y.map((y, k) => (data.inside[i][k] ? bounds([x, y, tagHeight()]) : null)));
}

function summary(cells, quantity) {
  const all = cells.flat().filter((c) => c !== null).map((c) => c[quantity]);
  const finite = all.filter(Number.isFinite).sort((p, q) => p - q);
  const share = (s) => {
    const at = s * (finite.length - 1), k = Math.floor(at);
    return finite.length ? finite[k] + (at - k) * (finite[Math.min(k + 1, finite.length - 1)] - finite[k]) : NaN;
  };
  const least = finite[0] ?? NaN;
  return {
    rms: Math.sqrt(finite.reduce((total, v) => total + v * v, 0) / finite.length),
    median: share(0.5), high: share(0.95), missing: 1 - finite.length / all.length, least,
    // A small spread shall not take all colours.
    most: Math.max(share(0.97), 2 * least), largest: share(1),
  };
}

let original = null;
function draw() {
  compute();
  const quantity = element("quantity").value, now = summary(computed, quantity);
  heat.width = data.x.length; heat.height = data.y.length;
  const context = heat.getContext("2d"), image = context.createImageData(heat.width, heat.height);
  for (let i = 0; i < data.x.length; i++) for (let k = 0; k < data.y.length; k++) {
    const one = computed[i][k], at = 4 * ((data.y.length - 1 - k) * heat.width + i);
    if (one === null) continue;
    const place = Math.min(1, Math.max(0, (one[quantity] - now.least) / (now.most - now.least || 1)));
    const colour = Number.isFinite(one[quantity]) ? data.colours[Math.round(place * (data.colours.length - 1))] : [160, 160, 160];
    image.data.set([...colour, 255], at);
  }
  context.putImageData(image, 0, 0);
  element("least").textContent = shown(now.least);
  element("most").textContent = shown(now.most) + (now.largest > now.most ? " and more" : "");
  if (original === null) original = {};
  original[`${quantity} ${tagHeight()}`] ??= asInRig(quantity);
  const line = (name, s) => `<tr><td>${name}</td><td data-label="RMS">${shown(s.rms)}</td><td data-label="median">${shown(s.median)}</td>`
    + `<td data-label="95 %">${shown(s.high)}</td><td data-label="not determined">${(100 * s.missing).toFixed(0)} %</td></tr>`;
  const proposed = anchors.filter((a) => a.proposed).map((a) => a.id);
  document.querySelector("#summary tbody").innerHTML = line("as in rig.toml", original[`${quantity} ${tagHeight()}`]) + line(`as drawn${proposed.length ? `, with ${proposed.join(", ")}` : ""}`, now);
  toml();
}

// The figures of the geometry in rig.toml, without what was dragged or proposed.
function asInRig(quantity) {
  const kept = [anchors, stations, computed];
  [anchors, stations] = [data.anchors, data.stations];
  compute();
  const figures = summary(computed, quantity);
  [anchors, stations, computed] = kept;
  return figures;
}

function toml() {
  const list = (values) => `[${values.map((v) => Number(v.toFixed(3))).join(", ")}]`;
  const lines = anchors.length ? ["[anchors]", ...anchors.map((a) => `${JSON.stringify(a.id)} = ${list(a.position)}`)] : [];
  for (const s of stations) lines.push(`[stations.${JSON.stringify(s.id)}]`, `position_m = ${list(s.position)}`);
  element("toml").textContent = lines.join("\n");
}

function bar() {
  const context = element("bar").getContext("2d");
  for (let k = 0; k < 256; k++) {
    context.fillStyle = `rgb(${data.colours[Math.floor(k * data.colours.length / 256)]})`;
    context.fillRect(k, 0, 1, 1);
  }
}

// ---- marks that can be dragged

function svg(name, attributes, parent) {
  const made = document.createElementNS("http://www.w3.org/2000/svg", name);
  for (const [key, value] of Object.entries(attributes)) made.setAttribute(key, value);
  parent.append(made);
  return made;
}

/** Lines of a round number of metres over the map, with their numbers in its margin. */
function grid(at, narrow) {
  const raw = Math.max(width, height) / 8, decade = 10 ** Math.floor(Math.log10(raw));
  const step = [1, 2, 5, 10].map((digit) => digit * decade).find((size) => size >= 0.999 * raw);
  const right = left + width, bottom = top_ - height;
  const line = ([x1, y1], [x2, y2]) => svg("line", { x1, y1, x2, y2, class: "grid" }, marks);
  const text = ([x, y], dx, dy, anchor, words) => {
    svg("text", { x: x + dx, y: y + dy, "text-anchor": anchor, class: "grid" }, marks).textContent = words;
  };
  const rounded = (value) => String(Number(value.toFixed(6)));
  for (let x = Math.ceil(left / step) * step; x < right + cell; x += step) {
    line(at([x, bottom]), at([x, top_]));
    text(at([x, bottom]), 0, 22, "middle", rounded(x));
  }
  for (let y = Math.ceil(bottom / step) * step; y < top_ + cell; y += step) {
    line(at([left, y]), at([right, y]));
    text(at([left, y]), -11, 4, "end", rounded(y));
  }
  if (narrow) return;
  text(at([right, bottom]), 12, 22, "start", "x (m)");
  text(at([left, top_]), -11, -14, "end", "y (m)");
}

function place() {
  const box = element("plan");
  box.style.aspectRatio = `${width + 2 * margin} / ${height + 2 * margin}`;
  Object.assign(heat.style, {
    left: `${100 * margin / (width + 2 * margin)}%`, top: `${100 * margin / (height + 2 * margin)}%`,
    width: `${100 * width / (width + 2 * margin)}%`, height: `${100 * height / (height + 2 * margin)}%`,
  });
  marks.replaceChildren();
  const pixels = box.clientWidth || 800, unit = (width + 2 * margin) / pixels;
  marks.setAttribute("viewBox", `0 0 ${pixels} ${pixels * (height + 2 * margin) / (width + 2 * margin)}`);
  const at = ([x, y]) => [(x - left + margin) / unit, (top_ + margin - y) / unit];
  const back = (px, py) => [px * unit + left - margin, top_ + margin - py * unit];
  const narrow = pixels < 600;
  grid(at, narrow);
  for (const [x1, y1, x2, y2] of data.walls) {
    const [a, b] = [at([x1, y1]), at([x2, y2])];
    svg("line", { x1: a[0], y1: a[1], x2: b[0], y2: b[1], stroke: "currentColor", "stroke-width": 1 }, marks);
  }
  for (const one of [...anchors, ...stations]) {
    const group = svg("g", { class: "mark", tabindex: 0, "data-id": one.id }, marks);
    const boresight = one.axes && svg("line", { stroke: "currentColor", "stroke-width": 2 }, group);
    const dot_ = svg("circle", { r: 8, fill: one.proposed ? "#d55e00" : "#1d2733", stroke: "#fff", "stroke-width": 1.5 }, group);
    const label = svg("text", {}, group);
    label.textContent = narrow ? one.id : `${one.id} (${one.position[2].toFixed(1)} m)`;
    const put = () => {
      const [px, py] = at(one.position);
      dot_.setAttribute("cx", px); dot_.setAttribute("cy", py);
      const right = px > pixels - 90;
      label.setAttribute("x", right ? px - 12 : px + 12); label.setAttribute("y", py + 4);
      label.setAttribute("text-anchor", right ? "end" : "start");
      if (boresight) {
        const end = at(sum(one.position, scaled(one.axes[2], 28 * unit)));
        for (const [k, v] of Object.entries({ x1: px, y1: py, x2: end[0], y2: end[1] })) boresight.setAttribute(k, v);
      }
    };
    put();
    const move = (x, y) => { one.position[0] = x; one.position[1] = y; put(); draw(); };
    group.addEventListener("pointerdown", (event) => { group.setPointerCapture(event.pointerId); event.preventDefault(); group.focus(); });
    group.addEventListener("pointermove", (event) => {
      if (!group.hasPointerCapture(event.pointerId)) return;
      const frame = marks.getBoundingClientRect();
      move(...back((event.clientX - frame.left) * pixels / frame.width, (event.clientY - frame.top) * pixels / frame.width));
    });
    group.addEventListener("keydown", (event) => {
      const way = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, 1], ArrowDown: [0, -1] }[event.key];
      if (!way) return;
      event.preventDefault();
      move(one.position[0] + way[0] * cell, one.position[1] + way[1] * cell);
    });
  }
  marks.onpointermove = (event) => {
    const frame = marks.getBoundingClientRect();
    const [x, y] = back((event.clientX - frame.left) * pixels / frame.width, (event.clientY - frame.top) * pixels / frame.width);
    const limits = bounds([x, y, tagHeight()]);
    element("hover").textContent = `At x ${x.toFixed(2)} m, y ${y.toFixed(2)} m: horizontal ${shown(limits.flat)} with the height known, `
      + `${shown(limits.horizontal)} with the height estimated; vertical ${shown(limits.vertical)}`;
  };
}

if (!data.anchors.length || data.stations.length) element("unit").querySelector("[value=dop]").remove();
for (const id of ["quantity", "unit", "height"]) element(id).addEventListener("input", draw);
element("reset").addEventListener("click", () => { reset(); anchors = anchors.filter((a) => !a.proposed); place(); draw(); });
window.addEventListener("resize", place);
reset(); bar(); place(); draw();
