// The data of the page: typed arrays from base64, and rows of tracks by time.

const KINDS = { f4: Float32Array, f8: Float64Array, u1: Uint8Array, u2: Uint16Array };

/** The content with every packed array replaced by a typed one. */
function unpacked(content) {
  if (content === null || typeof content !== "object") return content;
  if (Array.isArray(content)) return content.map(unpacked);
  if ("bdata" in content) {
    const text = atob(content.bdata), bytes = new Uint8Array(text.length);
    for (let k = 0; k < text.length; k++) bytes[k] = text.charCodeAt(k);
    return new KINDS[content.dtype](bytes.buffer);
  }
  return Object.fromEntries(Object.entries(content).map(([name, value]) => [name, unpacked(value)]));
}

/** The last row of a track at or before the time, or -1. */
function rowAt(recording, track, time) {
  const times = recording.columns.t;
  let low = track.first, high = track.end;
  while (low < high) {
    const middle = (low + high) >> 1;
    if (times[middle] <= time) low = middle + 1; else high = middle;
  }
  return low - 1 < track.first ? -1 : low - 1;
}

/** The number of the track of each row. */
function trackOfRows(recording) {
  const numbers = new Uint16Array(recording.columns.t.length);
  recording.tracks.forEach((track, k) => numbers.fill(k, track.first, track.end));
  return numbers;
}

/** Size of the error of a row: horizontal, or the angle to the true direction; NaN without truth. */
const missOf = (columns, row) => columns.miss ? columns.miss[row] : Math.hypot(columns.e0[row], columns.e1[row]);

/** An angle within half a turn of zero, degrees. */
const withinHalfTurn = (degrees) => degrees - 360 * Math.round(degrees / 360);

/** Size of the reported standard deviations of a row. */
const spreadOf = ({ s0, s1 }, row) => s1 ? Math.hypot(s0[row], s1[row]) : s0[row];

/** The number of a track with the same tag and station as another's, or -1. */
const sameTrack = (tracks, tag, station) => tracks.findIndex((track) => track.tag === tag && (track.station ?? undefined) === (station ?? undefined));

/** Rows from `first` to `end` whose time is in the window. */
function rowsWithin(columns, first, end, [from, to]) {
  const rows = [];
  for (let row = first; row < end; row++) if (columns.t[row] >= from && columns.t[row] <= to) rows.push(row);
  return rows;
}

/** At most about `most` of the rows: of each block those with the least and the largest value. */
function thinned(rows, values, most) {
  if (rows.length <= most) return rows;
  const size = Math.ceil(2 * rows.length / most), kept = [];
  for (let begin = 0; begin < rows.length; begin += size) {
    let least = rows[begin], largest = rows[begin];
    for (const row of rows.slice(begin, begin + size)) {
      if (values[row] < values[least]) least = row;
      if (values[row] > values[largest]) largest = row;
    }
    kept.push(...new Set([least, largest].sort((a, b) => a - b)));
  }
  return kept;
}

/** A column of the rows with null where the track has a gap or `apart(row, before)`, so that no line crosses it. */
function broken(rows, times, value, apart = () => false) {
  const steps = rows.slice(1).map((row, k) => times[row] - times[rows[k]]).sort((a, b) => a - b);
  const limit = Math.max(1, 10 * (steps[steps.length >> 1] || 0)), values = [];
  rows.forEach((row, k) => {
    if (k && (times[row] - times[rows[k - 1]] > limit || apart(row, rows[k - 1]))) values.push(null);
    values.push(value(row));
  });
  return values;
}
