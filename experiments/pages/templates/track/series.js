// Charts over time of one track: errors with the reported 3 σ and the bound, NIS, residuals of the readings.

const LINE_POINTS = 2500, PANEL = 150;

/** Panels of a recording: axes, NIS, kinds of residuals. */
function panelsOf(recording) {
  const known = recording.tracks.some((track) => track.rmse !== null), panels = [];
  for (const axis of recording.axes) {
    if (recording.angles || !known) panels.push({ kind: "value", axis });
    if (known) panels.push({ kind: "error", axis });
  }
  if (recording.nisBand) panels.push({ kind: "nis" });
  for (const channel of recording.residuals.channels) panels.push({ kind: "residual", channel });
  return panels;
}

/** Traces and layout of the panels for a track and a window of times. */
function seriesFigure(recording, number, window) {
  const { columns, tracks } = recording, track = tracks[number], panels = panelsOf(recording);
  const rows = rowsWithin(columns, track.first, track.end, window), traces = [], layout = {};
  const height = 1 / panels.length, gap = 0.16 * height;
  const named = new Set(), once = (name) => !named.has(name) && Boolean(named.add(name));
  panels.forEach((panel, k) => {
    const id = k ? k + 1 : "", on = { xaxis: "x", yaxis: `y${id}`, type: "scatter", mode: "lines" };
    const top = 1 - k * height;
    const axis = { domain: [top - height + gap, top], zeroline: false };
    if (panel.kind === "error" || panel.kind === "value") {
      const { name, unit, error, sigma, value, bound } = panel.axis;
      const isError = panel.kind === "error", column = columns[isError ? error : value];
      const apart = (row, before) => recording.angles && Math.abs(column[row] - column[before]) > 180;
      const kept = thinned(rows, column, LINE_POINTS), drawn = (of) => broken(kept, columns.t, of, apart);
      const at = drawn((row) => recording.start + columns.t[row]);
      const shift = isError ? 0 : recording.origin[panel.axis.value.slice(1)] * (recording.angles ? 0 : 1) || 0;
      const line = (sign) => drawn((row) => (isError ? 0 : shift + column[row]) + sign * 3 * columns[sigma][row]);
      const hover = `%{y:.${digitsOf(unit)}f} ${unit}`;
      const band = kept.some((row) => Number.isFinite(columns[sigma][row])) ? [
        { ...on, x: at, y: line(-1), line: { width: 0 }, hoverinfo: "skip", showlegend: false },
        { ...on, x: at, y: line(1), line: { width: 0 }, fill: "tonexty", fillcolor: "rgba(86,180,233,.28)",
          name: "reported ± 3 σ", legendgroup: "sigma", showlegend: once("sigma"), hovertemplate: isError ? `± ${hover}` : hover },
      ] : [];
      traces.push(...band,
        { ...on, x: at, y: drawn((row) => shift + column[row]), line: { color: themed("blue"), width: 1.2 },
          name: isError ? "error" : "estimate", legendgroup: panel.kind, showlegend: once(panel.kind), hovertemplate: hover },
      );
      if (!isError && track.rmse !== null) {
        const trueValue = (row) => withinHalfTurn(column[row] - columns[error][row]);
        const jumps = (row, before) => Math.abs(trueValue(row) - trueValue(before)) > 180;
        const known = kept.filter((row) => Number.isFinite(columns[error][row]));
        const along = (of) => broken(known, columns.t, of, jumps);
        traces.push({ ...on, x: along((row) => recording.start + columns.t[row]), y: along(trueValue), name: "truth", legendgroup: "truth",
                      showlegend: once("truth"), line: { color: themed("ink"), width: 1.2, dash: "dash" }, hovertemplate: `true ${hover}` });
      }
      if (isError && recording.bounds && bound && recording.bounds[bound]) {
        const t = Array.from(recording.bounds.t, (s) => s + recording.start);
        for (const sign of [1, -1]) {
          traces.push({ ...on, x: t, y: Array.from(recording.bounds[bound], (b) => 3 * sign * b), name: "± 3 × Cramér–Rao bound",
                        legendgroup: "bound", showlegend: sign > 0 && once("bound"), line: { color: "#d55e00", width: 1.1, dash: "dash" },
                        hoverinfo: "skip" });
        }
      }
      axis.title = { text: `${isError ? `error in${name.length > 9 ? "<br>" : " "}` : ""}${name} (${unit})` };
      axis.range = isError ? errorRange(columns, rows, error, sigma) : recording.angles ? angleRange(columns, rows, panel.axis) : undefined;
    } else if (panel.kind === "nis") {
      const ratio = (row) => columns.nis[row] / columns.dof[row];
      const kept = thinned(rows, columns.nis, LINE_POINTS);
      traces.push({ ...on, mode: "markers", x: kept.map((row) => recording.start + columns.t[row]), y: kept.map(ratio),
                    marker: { size: 3, color: "#009e73" }, name: "NIS/dof", hovertemplate: "%{y:.2f}" });
      axis.title = { text: "NIS/dof" };
      const sorted = kept.map(ratio).filter(Number.isFinite).sort((a, b) => a - b);
      axis.range = [0, Math.max(1.2 * (recording.nisBand[1] || 1), sorted[Math.floor(0.99 * (sorted.length - 1))] || 0)];
      layout.shapes = recording.nisBand.length ? [bandShape(`y${id}`, recording.nisBand)] : [];
    } else {
      traces.push(...residualTraces(recording, panel.channel, track.tag, window, on));
      axis.title = { text: `residual, ${panel.channel.name} (${panel.channel.unit})` };
    }
    layout[`yaxis${id}`] = axis;
  });
  const beside = besideJump(rows.map((row) => recording.start + columns.t[row]));
  const title = beside ? `${recording.timeLabel}, a jump of ${Number(beside.jump.toPrecision(3))} s left out` : recording.timeLabel;
  layout.xaxis = { title: { text: title }, range: beside?.range, anchor: `y${panels.length > 1 ? panels.length : ""}`, zeroline: false };
  return { traces, layout: layoutOf({ ...layout, hovermode: "x", uirevision: `${recording.name} ${number}`,
                                      height: 90 + PANEL * panels.length,
                                      // The legend has several lines on a phone.
                                      ...series.clientWidth < 500 && {
                                        margin: { l: 56, r: 12, t: 70, b: 44 },
                                        legend: { orientation: "h", x: 0, y: 1, yref: "container", yanchor: "top" },
                                      } }) };
}

/** Of times with a jump that is longer than nine times all others together: the jump and the side with more of them. */
function besideJump(times) {
  let at = 1;
  times.forEach((time, k) => { if (k && time - times[k - 1] > times[at] - times[at - 1]) at = k; });
  const first = times[0], last = times[times.length - 1], jump = times[at] - times[at - 1];
  if (times.length < 20 || !(jump > 0.9 * (last - first))) return null;
  return { jump, range: 2 * at > times.length ? [first, times[at - 1]] : [times[at], last] };
}

/** A band across the whole chart. */
const bandShape = (axis, [low, high]) => ({
  type: "rect", xref: "paper", x0: 0, x1: 1, yref: axis, y0: low, y1: high, fillcolor: "rgba(0,158,115,.14)", line: { width: 0 },
  layer: "below",
});

/** The estimated and true angles with a margin of the usual 3 σ, degrees. */
function angleRange(columns, rows, { value, error, sigma }) {
  const angles = rows.flatMap((row) => [columns[value][row], withinHalfTurn(columns[value][row] - columns[error][row])]).filter(Number.isFinite);
  if (!angles.length) return undefined;
  const sigmas = rows.map((row) => columns[sigma][row]).filter(Number.isFinite).sort((a, b) => a - b);
  const low = angles.reduce((a, b) => Math.min(a, b)), high = angles.reduce((a, b) => Math.max(a, b));
  const margin = 0.06 * (high - low) + Math.min(3 * (sigmas[sigmas.length >> 1] || 0.3), 20);
  return [low - margin, high + margin];
}

/** Half the axis: every error that lasts for two rows, and the usual 3 σ band up to four times as much. */
function errorRange(columns, rows, error, sigma) {
  let most = 0;
  rows.forEach((row, k) => {
    const other = rows[k + 1] === undefined ? 0 : Math.abs(columns[error][rows[k + 1]]);
    const lasting = Math.min(Math.abs(columns[error][row]), other);
    if (lasting > most) most = lasting;
  });
  const sigmas = rows.map((row) => columns[sigma][row]).filter(Number.isFinite).sort((a, b) => a - b);
  const band = 3 * (sigmas[Math.floor(0.9 * (sigmas.length - 1))] || 0);
  const half = 1.1 * Math.max(most, Math.min(band, 4 * most || Infinity)) || 1;
  return [-half, half];
}

/** Residuals of the readings of a tag about its estimates, in the colours of their anchors or stations. */
function residualTraces(recording, channel, tag, window, on) {
  const { points } = channel, number = recording.residuals.tags.indexOf(tag);
  const values = channel.boxes.estimated ? points.estimated : points.true;
  return channel.sources.map((source, k) => {
    const ofSource = [];
    for (let at = 0; at < values.length; at++) {
      const inside = points.t[at] >= window[0] && points.t[at] <= window[1];
      if (points.source[at] === k && points.tag[at] === number && inside && Number.isFinite(values[at])) ofSource.push(at);
    }
    const shown = FAST ? ofSource : thinned(ofSource, values, 1500 / channel.sources.length);
    return { ...on, type: MARKS, mode: "markers", x: shown.map((at) => recording.start + points.t[at]),
             y: shown.map((at) => values[at]), name: escaped(source), legendgroup: `source ${k}`,
             showlegend: channel === recording.residuals.channels[0] && channel.sources.length > 1,
             marker: { size: 3.5, color: lineColour(k), opacity: 0.7 },
             hovertemplate: `${escaped(source)}: %{y:.3f} ${channel.unit}<extra></extra>` };
  }).filter((trace) => trace.x.length);
}
