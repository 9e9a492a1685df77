// The floor plan: rig, true paths and estimates; the overlay draws upon it what moves.

/** What the plan draws of a recording of positions: places of a row, what surrounds them, and the layout. */
function floorOf(recording) {
  const { columns, rig, origin } = recording, at = (row) => [columns.v0[row], columns.v1[row]];
  const truth = (row) => [columns.v0[row] - columns.e0[row], columns.v1[row] - columns.e1[row]];
  const axis = (name, k) => ({ title: { text: fromOrigin(name, origin[k]) }, range: planRange(recording, k), zeroline: false });
  return {
    at, truth, words: "",
    region: (row) => ellipse(columns, row),
    miss: (row) => [at(row), truth(row)],
    background: () => [
      { x: rig.walls.flatMap((s) => [s[0], s[2], null]), y: rig.walls.flatMap((s) => [s[1], s[3], null]), width: 3 },
      { x: rig.path.map((p) => p[0]), y: rig.path.map((p) => p[1]), width: 1, name: "known path", dash: "dot" },
    ].filter(({ x }) => x.length).map(({ width, dash, name, ...line }) => ({
      ...line, mode: "lines", hoverinfo: "skip", name, showlegend: Boolean(name), line: { color: themed("soft"), width, dash },
    })),
    mounted: () => [...mountedAt(rig.anchors, "anchor", "triangle-up"), ...mountedAt(rig.stations, "station", "square")],
    layout: () => ({
      xaxis: axis("x", 0), yaxis: { ...axis("y", 1), scaleanchor: "x" }, hovermode: "closest", dragmode: "pan",
      uirevision: recording.name, margin: { l: 56, r: 12, t: 40, b: 44 },
    }),
  };
}

const MOST_TRUTHS = 6;  // more true paths would hide the estimates

/** The traces of the plan by its `view`; `shown`: the tracks whose estimates are drawn. */
function planTraces(recording, view, shown, kind) {
  const { columns, tracks } = recording, ink = themed("ink"), rows = [], truth = [], ends = [];
  for (const k of shown) {
    const known = rowsOf(tracks[k]).filter((row) => Number.isFinite(columns.v0[row]));
    rows.push(...thinned(known, columns.t, FAST ? Infinity : Math.max(50, 3000 / shown.length)));
    if (shown.length > MOST_TRUTHS || !known.length) continue;
    truth.push(...broken(thinned(known, columns.t, Math.max(400, 12000 / shown.length)), columns.t, view.truth), null);
    ends.push([view.at(known[0]), "circle-open"], [view.at(known.at(-1)), "square-open"]);
  }
  const along = (places) => ({ x: places.map((p) => p && p[0]), y: places.map((p) => p && p[1]) });
  const still = { hoverinfo: "skip" }, traces = [...view.background()];
  if (truth.some((p) => p && Number.isFinite(p[0]))) {
    traces.push({ ...still, ...along(truth), mode: "lines", name: "truth", line: { color: ink, width: 1.2, dash: "dash" } });
  }
  traces.push({
    ...along(rows.map(view.at)), customdata: rows, type: MARKS, mode: "markers", name: "estimates", hoverinfo: "x+y", meta: "estimates",
    marker: { size: rows.length > 5000 ? 3.5 : 5, opacity: 0.75, ...markerColours(recording, kind, rows) },
  });
  traces.push({ ...still, ...along(ends.map(([place]) => place)), mode: "markers", name: "start ○ and end □",
                marker: { symbol: ends.map(([, mark]) => mark), size: 13, color: ink, line: { width: 2 } } });
  return [...traces, ...view.mounted()];
}

/** Anchors or stations. */
const mountedAt = (list, name, symbol) => !list.length ? [] : [{
  x: list.map((one) => one.at[0]), y: list.map((one) => one.at[1]), mode: "markers+text", name, textposition: "bottom center",
  text: list.map((one) => escaped(one.name)), cliponaxis: false, hoverinfo: "text", textfont: { size: 11 },
  hovertext: list.map((one) => `${name} ${escaped(one.name)}, z ${fixed(one.at[2], 2)} m`), marker: { symbol, size: 10, color: themed("soft") },
}];

/** The range of an axis: rig, truth, and 98 % of the estimates of each track, with a margin. */
function planRange({ columns, rig, tracks }, axis) {
  const sure = [...rig.anchors, ...rig.stations].map((one) => one.at[axis]);
  sure.push(...rig.path.map((p) => p[axis]), ...rig.walls.flatMap((w) => [w[axis], w[axis + 2]]));
  for (const { first, end } of tracks) {
    const values = columns[`v${axis}`].subarray(first, end), errors = columns[`e${axis}`].subarray(first, end);
    const truth = values.map((value, k) => value - errors[k]);
    const known = values.some(Number.isFinite), scored = truth.some(Number.isFinite);
    sure.push(...known ? [quantile(values, 0.01), quantile(values, 0.99)] : [], ...scored ? [quantile(truth, 0), quantile(truth, 1)] : []);
  }
  const [low, high] = sure.length ? [Math.min(...sure), Math.max(...sure)] : [-1, 1], margin = Math.max(0.06 * (high - low), 0.25);
  return [low - margin, high + margin];
}
