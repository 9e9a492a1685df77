// Directions without positions: the station in the middle, the angle around it, time from the inner circle outwards.

const INNER = 0.25, LEVEL_95_ALONE = 1.959963985;  // quantile of a normal distribution, both sides

/** What the plan draws of a recording of bearings; the interface is that of `floorOf`. */
function polarOf(recording) {
  const { columns, axes } = recording, length = Math.max(recording.end - recording.start, 1e-3);
  const flat = axes.length === 1;  // the angle in the plane of an array, from its x axis; else azimuth from the boresight
  const radius = (t) => INNER + (1 - INNER) * t / length;
  const point = (degrees, r) => {
    const angle = degrees * Math.PI / 180;
    return flat ? [r * Math.cos(angle), r * Math.sin(angle)] : [-r * Math.sin(angle), r * Math.cos(angle)];
  };
  const arc = (from, to, r) => Array.from({ length: 61 }, (_, k) => point(from + (to - from) * k / 60, r));
  const trueAngle = (row) => withinHalfTurn(columns.v0[row] - columns.e0[row]);
  const all = [...columns.v0, ...Array.from(columns.v0, (_, row) => trueAngle(row))], low = quantile(all, 0), high = quantile(all, 1);
  // The sector that holds all directions, or the whole circle.
  const [from, to] = high - low < 120 ? [low - 10, high + 10] : [-180, 180];

  function background() {
    const step = to - from < 60 ? 10 : 30, lines = [], labels = [], beside = to - from < 360 ? from : flat ? -105 : -165;
    for (let angle = Math.ceil(from / step) * step; angle <= to && angle < from + 360; angle += step) {
      lines.push([0, 0], point(angle, 1), [null, null]);
      labels.push([point(angle, 1.06), `${fixed(angle, 0)}°`]);
    }
    for (const time of [0, 1, 2, 3, 4].map((k) => k * length / 4)) {
      lines.push(...arc(from, to, radius(time)), [null, null]);
      labels.push([point(beside, radius(time)), `${fixed(recording.start + time, length < 10 ? 1 : 0)} s`]);
    }
    const trace = (places, more) => ({ hoverinfo: "skip", showlegend: false, x: places.map((p) => p[0]), y: places.map((p) => p[1]), ...more });
    return [
      trace(lines, { mode: "lines", line: { color: themed("line"), width: 1 } }),
      trace(labels.map(([p]) => p), { mode: "text", text: labels.map(([, text]) => text), textfont: { size: 11, color: themed("soft") } }),
      trace([[0, 0]], { mode: "markers", marker: { symbol: "square", size: 10, color: themed("soft") } }),
    ];
  }

  function layout() {
    const corners = [[0, 0], ...arc(from, to, 1.12)], axis = (k) => {
      const values = corners.map((p) => p[k]);
      return { visible: false, range: [Math.min(...values) - 0.06, Math.max(...values) + 0.06] };
    };
    return { xaxis: axis(0), yaxis: { ...axis(1), scaleanchor: "x" }, hovermode: "closest", dragmode: "pan", uirevision: recording.name,
             margin: { l: 12, r: 12, t: 40, b: 12 } };
  }

  return {
    at: (row) => point(columns.v0[row], radius(columns.t[row])),
    truth: (row) => point(trueAngle(row), radius(columns.t[row])),
    region(row) {
      const half = Math.min(LEVEL_95_ALONE * columns.s0[row], 180), angle = columns.v0[row];
      return [[0, 0], ...Number.isFinite(half) ? arc(angle - half, angle + half, 1) : [point(angle, 1)]];
    },
    miss: (row) => [[0, 0], point(trueAngle(row), 1)],
    background,
    mounted: () => [],
    layout,
    words: `The station is in the middle${flat ? ", the x axis of its array to the right" : ", its boresight up, positive azimuth to the left"}; ` +
      "time runs from the inner circle outwards. The ray is the estimate of the moment, with its 95 % interval where the tracker reports one, " +
      "the dashed ray the true direction.",
  };
}
