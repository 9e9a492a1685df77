// Numbers, names and rows as text.

const escaped = (text) => String(text).replace(/&/g, "&amp;").replace(/</g, "&lt;").replace(/>/g, "&gt;");

const fixed = (value, digits) => Number.isFinite(value) ? value.toFixed(digits).replace("-", "\u2212") : "–";

/** The name of a coordinate in metres from `origin`. */
const fromOrigin = (name, origin) => name + (origin > 0 ? ` − ${origin}` : origin < 0 ? ` + ${-origin}` : "") + " (m)";

const naturally = (a, b) => a.localeCompare(b, "en", { numeric: true });

const digitsOf = (unit) => unit === "m" ? 3 : 2;

const withUnit = (value, unit) => Number.isFinite(value) ? `${fixed(value, digitsOf(unit))}\u202f${unit}` : "–";

const nameOf = (track) => track.station === null ? track.tag : `${track.tag}, station ${track.station}`;

/** Pairs of a name and a text: the numbers of one estimate. */
function numbersOf(recording, row) {
  const { columns, axes, angles } = recording, unit = axes[0].unit;
  const pairs = [["time", `${fixed(recording.start + columns.t[row], 2)}\u202fs`]];
  axes.forEach((axis, k) => {
    const value = columns[axis.value][row] + (angles ? 0 : recording.origin[k] || 0);
    const sigma = columns[axis.sigma][row];
    pairs.push([axis.name, withUnit(value, unit) + (Number.isFinite(sigma) ? ` ± ${fixed(sigma, digitsOf(unit))}` : "")]);
  });
  const miss = missOf(columns, row);
  if (Number.isFinite(miss)) pairs.push([angles ? "angle to the truth" : "horizontal error", withUnit(miss, unit)]);
  if (!angles && axes.length > 2) pairs.push(["error in z", withUnit(columns.e2[row], unit)]);
  const nees = neesOf(columns, row);
  if (Number.isFinite(nees)) pairs.push(["NEES/dof", fixed(nees, 2)]);
  if (columns.dof[row] > 0) pairs.push(["NIS/dof", fixed(columns.nis[row] / columns.dof[row], 2)]);
  if (recording.sources.length) pairs.push([angles ? "station" : "reading of", recording.sources[columns.source[row]]]);
  pairs.push(["status", recording.statuses[columns.status[row]]]);
  return pairs;
}

/** NEES per degree of freedom of the horizontal position, of both angles, or of the only one. */
function neesOf(columns, row) {
  if (!columns.s1) return (columns.e0[row] / columns.s0[row]) ** 2;
  const a = columns.s0[row] ** 2, b = columns.cov ? columns.cov[row] : 0, c = columns.s1[row] ** 2;
  const x = columns.e0[row], y = columns.e1[row];
  return (c * x * x - 2 * b * x * y + a * y * y) / (a * c - b * b) / 2;
}
