// The data of the page: typed arrays from base64, and rows of tracks by time.

const KINDS = { f4: Float32Array, f8: Float64Array, u1: Uint8Array, u2: Uint16Array };

/** JSON with every packed array replaced by a typed one. */
const unpacked = (text) => JSON.parse(text, (_, value) => value?.bdata === undefined ? value
  : new KINDS[value.dtype](Uint8Array.from(atob(value.bdata), (c) => c.charCodeAt(0)).buffer));

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

/** Size of the error of a row: horizontal, or the angle to the true direction; NaN without truth. */
const missOf = (columns, row) => columns.miss ? columns.miss[row] : Math.hypot(columns.e0[row], columns.e1[row]);

/** An angle within half a turn of zero, degrees. */
const withinHalfTurn = (degrees) => degrees - 360 * Math.round(degrees / 360);

/** The number of a track with the same tag and station, or -1. */
const trackOf = (tracks, tag, station) => tracks.findIndex((track) => track.tag === tag && track.station === station);

/** The rows of a track. */
const rowsOf = ({ first, end }) => Array.from({ length: end - first }, (_, k) => first + k);

/** At most about `most` of the rows: of each block those with the least and the largest value. */
function thinned(rows, values, most) {
  if (rows.length <= most) return rows;
  const size = Math.ceil(2 * rows.length / most), kept = [];
  for (let begin = 0; begin < rows.length; begin += size) {
    const block = rows.slice(begin, begin + size), by = (sign) => block.reduce((a, b) => sign * values[b] > sign * values[a] ? b : a);
    kept.push(...new Set([by(-1), by(1)].sort((a, b) => a - b)));
  }
  return kept;
}

/** The value of each row, null before one after a gap or where `apart(row, before)`, so that no line crosses it. */
function broken(rows, times, value, apart = () => false) {
  const steps = rows.slice(1).map((row, k) => times[row] - times[rows[k]]);
  const limit = Math.max(1, 10 * quantile(steps, 0.5));
  return rows.flatMap((row, k) => k && (steps[k - 1] > limit || apart(row, rows[k - 1])) ? [null, value(row)] : [value(row)]);
}

/** A quantile of the numbers among the values; 0 of none. */
function quantile(values, share) {
  const known = [...values].filter(Number.isFinite).sort((a, b) => a - b);
  return known.length ? known[Math.floor(share * (known.length - 1))] : 0;
}
