// Directions without positions: the station in the middle, the angle around it, time from the inner circle outwards.

const INNER = 0.25, LEVEL_95_ALONE = 1.959963985;  // quantile of a normal distribution, both sides

/** What the plan draws of a recording of bearings; the interface is that of `floorOf`. */
function polarOf(recording) {
  const { columns, axes, tracks } = recording, length = Math.max(recording.end - recording.start, 1e-3);
  const flat = axes.length === 1;  // the angle in the plane of an array, from its x axis; else azimuth from the boresight
  const radius = (t) => INNER + (1 - INNER) * t / length;
  const point = (degrees, r) => {
    const angle = degrees * Math.PI / 180;
    return flat ? [r * Math.cos(angle), r * Math.sin(angle)] : [-r * Math.sin(angle), r * Math.cos(angle)];
  };
  const arc = (from, to, r) => Array.from({ length: 61 }, (_, k) => point(from + (to - from) * k / 60, r));
  const trueAngle = (row) => withinHalfTurn(columns.v0[row] - columns.e0[row]);
  const [from, to] = anglesShown();

  /** The sector that holds all directions, or the whole circle, in degrees. */
  function anglesShown() {
    let low = Infinity, high = -Infinity;
    for (const track of tracks) {
      for (let row = track.first; row < track.end; row++) {
        for (const angle of [columns.v0[row], trueAngle(row)]) {
          if (Number.isFinite(angle)) { low = Math.min(low, angle); high = Math.max(high, angle); }
        }
      }
    }
    return high - low < 120 ? [low - 10, high + 10] : [-180, 180];
  }

  function background() {
    const soft = themed("soft"), line = themed("line"), step = to - from < 60 ? 10 : 30, lines = [], labels = [];
    for (let angle = Math.ceil(from / step) * step; angle <= to && angle < from + 360; angle += step) {
      lines.push([0, 0], point(angle, 1), [null, null]);
      labels.push([point(angle, 1.06), `${fixed(angle, 0)}°`]);
    }
    const beside = to - from < 360 ? from : flat ? -105 : -165;
    for (const time of roundTimes(length)) {
      lines.push(...arc(from, to, radius(time)), [null, null]);
      labels.push([point(beside, radius(time)), `${fixed(recording.start + time, length < 10 ? 1 : 0)} s`]);
    }
    const common = { type: "scatter", hoverinfo: "skip", showlegend: false };
    return [
      { ...common, x: lines.map((p) => p[0]), y: lines.map((p) => p[1]), mode: "lines", line: { color: line, width: 1 } },
      { ...common, x: labels.map(([p]) => p[0]), y: labels.map(([p]) => p[1]), mode: "text", text: labels.map(([, text]) => text),
        textfont: { size: 11, color: soft } },
      { ...common, x: [0], y: [0], mode: "markers", marker: { symbol: "square", size: 10, color: soft } },
    ];
  }

  function layout() {
    const corners = [[0, 0], ...arc(from, to, 1.12)], range = (axis) => {
      const values = corners.map((p) => p[axis]);
      return [Math.min(...values) - 0.06, Math.max(...values) + 0.06];
    };
    return {
      xaxis: { visible: false, range: range(0) }, yaxis: { visible: false, range: range(1), scaleanchor: "x" },
      hovermode: "closest", dragmode: "pan", uirevision: recording.name, margin: { l: 12, r: 12, t: 40, b: 12 },
    };
  }

  return {
    at: (row) => point(columns.v0[row], radius(columns.t[row])),
    truth: (row) => point(trueAngle(row), radius(columns.t[row])),
    region(row) {
      const half = Math.min(LEVEL_95_ALONE * columns.s0[row], 180), angle = columns.v0[row];
      return Number.isFinite(half) ? [[0, 0], ...arc(angle - half, angle + half, 1)] : [[0, 0], point(angle, 1)];
    },
    miss: (row) => [[0, 0], point(trueAngle(row), 1)],
    background,
    mounted: () => [],
    layout,
    words: `The station is in the middle${flat ? ", the x axis of its array to the right" : ", its boresight up, positive azimuth to the left"}; ` +
      "time runs from the inner circle outwards. The ray is the estimate of the moment, with the sector of its 95 % interval where the " +
      "tracker reports one, the dashed ray the true direction.",
  };
}

/** Some round times from zero to `length`, s. */
function roundTimes(length) {
  const raw = length / 4, decade = 10 ** Math.floor(Math.log10(raw));
  const step = [1, 2, 5, 10].map((digit) => digit * decade).find((size) => size >= raw * 0.99);
  return Array.from({ length: Math.floor(length / step) + 1 }, (_, k) => k * step);
}
