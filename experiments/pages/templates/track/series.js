// Charts over time of one track: errors with the reported 3 σ, NIS, residuals of the readings.

const LINE_POINTS = 2500, PANEL = 150;

/** Traces and layout of the panels for a track: axes, NIS, kinds of residuals. */
function seriesFigure(recording, number) {
  const { columns, tracks, angles } = recording, track = tracks[number], rows = rowsOf(track);
  const known = tracks.some((one) => one.rmse !== null), panels = [];
  for (const axis of recording.axes) {
    if (angles || !known) panels.push((on) => valuePanel(recording, track, rows, axis, on));
    if (known) panels.push((on) => errorPanel(recording, rows, axis, on));
  }
  if (recording.nisBand) panels.push((on) => nisPanel(recording, rows, on));
  for (const channel of recording.residuals.channels) panels.push((on) => residualPanel(recording, channel, track.tag, on));
  const traces = [], shapes = [], layout = { hovermode: "x", uirevision: `${recording.name} ${number}`, height: 90 + PANEL * panels.length };
  const names = new Set(), height = 1 / panels.length;
  panels.forEach((panel, k) => {
    const id = k ? k + 1 : "", { lines, title, range, band } = panel({ xaxis: "x", yaxis: `y${id}`, type: "scatter", mode: "lines" });
    for (const line of lines) {
      // A name is once in the legend and stands for all its lines.
      const shown = line.name !== undefined && !names.has(line.name);
      traces.push({ ...line, legendgroup: line.name, showlegend: shown });
      names.add(line.name);
    }
    layout[`yaxis${id}`] = { title: { text: title }, range, domain: [1 - (k + 0.84) * height, 1 - k * height], zeroline: false };
    if (band?.length) shapes.push(bandShape(`y${id}`, band));
  });
  const beside = besideJump(rows.map((row) => recording.start + columns.t[row]));
  const text = recording.timeLabel + (beside ? `, a jump of ${Number(beside.jump.toPrecision(3))} s left out` : "");
  layout.xaxis = { title: { text }, range: beside?.range, anchor: `y${panels.length > 1 ? panels.length : ""}`, zeroline: false };
  const legend = { orientation: "h", x: 0, itemsizing: "constant" }, placed = series.clientWidth < 500  // several lines on a phone
    ? { margin: { l: 56, r: 12, t: 70, b: 44 }, legend: { ...legend, y: 1, yref: "container", yanchor: "top" } }
    : { legend: { ...legend, y: 1.01, yanchor: "bottom" } };
  return { traces, layout: layoutOf({ ...layout, shapes, ...placed }) };
}

/** What two lines enclose, run by run: between lines with gaps plotly.js fills the gaps, too. */
function enclosed(x, low, high) {
  const ends = [-1, ...[...x.keys()].filter((k) => x[k] === null), x.length];
  const around = (there, back) => ends.slice(1).flatMap((end, k) => {
    const run = [ends[k] + 1, end];
    return [...there.slice(...run), ...back.slice(...run).reverse(), null];
  });
  return { x: around(x, x), y: around(high, low) };
}

/** A line with its band of 3 σ about it or, of an error, about zero. */
function withBand(recording, rows, { unit, sigma }, column, shift, name, on) {
  const { columns: { t, [sigma]: sigmas }, angles, start } = recording;
  const apart = (row, before) => angles && Math.abs(column[row] - column[before]) > 180;
  const kept = thinned(rows, column, LINE_POINTS), drawn = (of) => broken(kept, t, of, apart);
  const x = drawn((row) => start + t[row]), hover = `%{y:.${digitsOf(unit)}f} ${unit}`, middle = (row) => name === "error" ? 0 : shift + column[row];
  const edge = (sign) => drawn((row) => middle(row) + sign * 3 * sigmas[row]), high = edge(1), named = { ...on, name: "reported ± 3 σ", line: { width: 0 } };
  const wide = drawn((row) => Number.isFinite(sigmas[row]) ? start + t[row] : null);
  const band = kept.some((row) => Number.isFinite(sigmas[row])) ? [
    { ...named, ...enclosed(wide, edge(-1), high), fill: "toself", fillcolor: "rgba(86,180,233,.28)", hoverinfo: "skip" },
    { ...named, x, y: high, hovertemplate: hover },
  ] : [];
  return [...band, { ...on, x, y: drawn((row) => shift + column[row]), line: { color: themed("blue"), width: 1.2 }, name, hovertemplate: hover }];
}

function valuePanel(recording, track, rows, axis, on) {
  const { columns, angles, origin, start } = recording, column = columns[axis.value], errors = columns[axis.error];
  const lines = withBand(recording, rows, axis, column, angles ? 0 : origin[axis.value.slice(1)] || 0, "estimate", on);
  const truth = (row) => withinHalfTurn(column[row] - errors[row]), scored = angles ? rows.filter((row) => Number.isFinite(errors[row])) : [];
  if (track.rmse !== null) {
    const along = (of) => broken(thinned(scored, column, LINE_POINTS), columns.t, of, (row, before) => Math.abs(truth(row) - truth(before)) > 180);
    lines.push({ ...on, x: along((row) => start + columns.t[row]), y: along(truth), name: "truth", line: { color: themed("ink"), width: 1.2, dash: "dash" },
                 hovertemplate: `true %{y:.2f} ${axis.unit}` });
  }
  const values = [...rows.map((row) => column[row]), ...scored.map(truth)], low = quantile(values, 0), high = quantile(values, 1);
  const margin = 0.06 * (high - low) + Math.min(3 * (quantile(rows.map((row) => columns[axis.sigma][row]), 0.5) || 0.3), 20);
  return { lines, title: `${axis.name} (${axis.unit})`, range: angles ? [low - margin, high + margin] : undefined };
}

function errorPanel(recording, rows, axis, on) {
  const { columns } = recording, errors = columns[axis.error];
  const lines = withBand(recording, rows, axis, errors, 0, "error", on);
  // Every error that lasts for two rows, and the usual 3 σ band up to four times as much.
  const lasting = quantile(rows.map((row, k) => Math.min(Math.abs(errors[row]), Math.abs(errors[rows[k + 1]] ?? 0))), 1);
  const band = 3 * quantile(rows.map((row) => columns[axis.sigma][row]), 0.9), half = 1.1 * Math.max(lasting, Math.min(band, 4 * lasting || Infinity)) || 1;
  return { lines, title: `error in${axis.name.length > 9 ? "<br>" : " "}${axis.name} (${axis.unit})`, range: [-half, half] };
}

function nisPanel({ columns, nisBand, start }, rows, on) {
  const ratio = (row) => columns.nis[row] / columns.dof[row], kept = thinned(rows, columns.nis, LINE_POINTS), y = kept.map(ratio);
  const lines = [{ ...on, mode: "markers", x: kept.map((row) => start + columns.t[row]), y, marker: { size: 3, color: "#009e73" }, name: "NIS/dof",
                   hovertemplate: "%{y:.2f}" }];
  return { lines, title: "NIS/dof", range: [0, Math.max(1.2 * (nisBand[1] || 1), quantile(y, 0.99))], band: nisBand };
}

/** Residuals of the readings of a tag, in the colours of their anchors or stations. */
function residualPanel(recording, { name, unit, sources, points: { t, tag, source, value } }, of, on) {
  const number = recording.residuals.tags.indexOf(of);
  const lines = sources.map((sourceName, k) => {
    const own = [...value.keys()].filter((at) =>
      source[at] === k && tag[at] === number && Number.isFinite(value[at]));
    const shown = FAST ? own : thinned(own, value, 1500 / sources.length);
    return { ...on, type: MARKS, mode: "markers", x: shown.map((at) => recording.start + t[at]), y: shown.map((at) => value[at]),
             name: sources.length > 1 ? escaped(sourceName) : undefined, marker: { size: 3.5, color: lineColour(k), opacity: 0.7 },
             hovertemplate: `${escaped(sourceName)}: %{y:.3f} ${unit}<extra></extra>` };
  });
  // A few wild readings do not flatten the others.
  const sizes = lines.flatMap((line) => line.y.map(Math.abs)), half = 3 * quantile(sizes, 0.95);
  const beyond = quantile(sizes, 1) > 2 * half ? sizes.filter((size) => size > half).length : 0;
  return { lines: lines.filter((line) => line.x.length), range: beyond ? [-half, half] : undefined,
           title: `residual, ${name} (${unit})${beyond ? `<br>${beyond} beyond` : ""}` };
}

/** Of times with a jump that is longer than nine times all others together: the jump and the side with more of them. */
function besideJump(times) {
  let at = 1;
  times.forEach((time, k) => { if (k && time - times[k - 1] > times[at] - times[at - 1]) at = k; });
  const first = times[0], last = times.at(-1), jump = times[at] - times[at - 1];
  if (times.length < 20 || !(jump > 0.9 * (last - first))) return null;
  return { jump, range: 2 * at > times.length ? [first, times[at - 1]] : [times[at], last] };
}

/** A band across the whole chart. */
const bandShape = (axis, [low, high]) => ({
  type: "rect", xref: "paper", x0: 0, x1: 1, yref: axis, y0: low, y1: high, fillcolor: "rgba(0,158,115,.14)", line: { width: 0 }, layer: "below",
});
