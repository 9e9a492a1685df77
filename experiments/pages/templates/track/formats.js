// Numbers, names, colours and rows as text.

const escaped = (text) => String(text).replace(/&/g, "&amp;").replace(/</g, "&lt;").replace(/>/g, "&gt;");
const fixed = (value, digits) => Number.isFinite(value) ? value.toFixed(digits).replace("-", "\u2212") : "–";
const digitsOf = (unit) => unit === "m" ? 3 : 2;
const withUnit = (value, unit) => Number.isFinite(value) ? `${fixed(value, digitsOf(unit))}\u202f${unit}` : "–";
const nameOf = (track) => track.station === null ? track.tag : `${track.tag}, station ${track.station}`;

/** The name of a coordinate in metres from `origin`. */
const fromOrigin = (name, origin) => name + (origin > 0 ? ` − ${origin}` : origin < 0 ? ` + ${-origin}` : "") + " (m)";

const LINES = ["#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9"];
const lineColour = (k) => LINES[k % LINES.length];

/** Whether the browser draws many points fast; without it there are fewer of them. */
const FAST = ["webgl2", "webgl"].some((kind) => document.createElement("canvas").getContext(kind));
const MARKS = FAST ? "scattergl" : "scatter";

/** Pairs of a name and a text: the numbers of one estimate. */
function numbersOf(recording, row) {
  const { columns, axes, angles } = recording, unit = axes[0].unit, pairs = [["time", `${fixed(recording.start + columns.t[row], 2)}\u202fs`]];
  axes.forEach((axis, k) => {
    const sigma = columns[axis.sigma][row], value = columns[axis.value][row] + (angles ? 0 : recording.origin[k] || 0);
    pairs.push([axis.name, withUnit(value, unit) + (Number.isFinite(sigma) ? ` ± ${fixed(sigma, digitsOf(unit))}` : "")]);
  });
  const known = (name, value, text) => Number.isFinite(value) && pairs.push([name, text(value)]);
  known(angles ? "angle to the truth" : "horizontal error", missOf(columns, row), (miss) => withUnit(miss, unit));
  if (!angles && axes.length > 2) known("error in z", columns.e2[row], (error) => withUnit(error, unit));
  if (columns.dof[row] > 0) pairs.push(["NIS/dof", fixed(columns.nis[row] / columns.dof[row], 2)]);
  return [...pairs, ["status", recording.statuses[columns.status[row]]]];
}

/** What the rows of a recording can be coloured by, each with its title and the value of a row. */
function colourings(recording) {
  const { columns, tracks } = recording, kinds = {
    error: [`error (${recording.axes[0].unit})`, (row) => missOf(columns, row), tracks.some((track) => track.rmse !== null)],
    "NIS/dof": ["NIS/dof", (row) => columns.nis[row] / columns.dof[row], recording.nisBand],
    tag: ["tag", (row) => recording.trackOf[row], true],
  };
  return Object.fromEntries(Object.entries(kinds).filter(([, kind]) => kind[2]));
}

/** The colour of each row as settings of its marker. */
function markerColours(recording, kind, rows) {
  const [title, value] = colourings(recording)[kind], values = rows.map(value);
  if (kind === "tag") return { color: values.map(lineColour) };
  const top = kind === "NIS/dof" ? 4 : quantile(values, 0.98);
  return {
    color: values.map((v) => Number.isFinite(v) ? v : 0), cmin: 0, cmax: top || 1, colorscale: "Viridis",
    colorbar: { title: { text: title, side: "right" }, thickness: 12, len: 0.85, outlinewidth: 0 },
  };
}
