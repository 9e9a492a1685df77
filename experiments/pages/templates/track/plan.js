// The floor plan: rig, true paths and estimates; the overlay draws upon it what moves.

/** What the plan draws of a recording of positions: places of a row, what surrounds them, and the layout. */
function floorOf(recording) {
  const { columns } = recording;
  const at = (row) => [columns.v0[row], columns.v1[row]];
  const truth = (row) => [columns.v0[row] - columns.e0[row], columns.v1[row] - columns.e1[row]];
  const { rig } = recording;
  return {
    at,
    truth,
    region: (row) => ellipse(columns, row),
    miss: (row) => [at(row), truth(row)],
    background: () => floorTraces(rig),
    mounted: () => [...mountedAt(rig.anchors, "anchor", "triangle-up"), ...mountedAt(rig.stations, "station", "square")],
    layout: () => planLayout(recording),
    words: "",
  };
}

/** Walls and the known path. */
function floorTraces(rig) {
  const soft = themed("soft"), traces = [];
  if (rig.walls.length) {
    traces.push({
      x: rig.walls.flatMap((s) => [s[0], s[2], null]), y: rig.walls.flatMap((s) => [s[1], s[3], null]), type: "scatter",
      mode: "lines", hoverinfo: "skip", showlegend: false, line: { color: soft, width: 3 },
    });
  }
  if (rig.path.length) {
    traces.push({
      x: rig.path.map((p) => p[0]), y: rig.path.map((p) => p[1]), type: "scatter", mode: "lines", name: "known path",
      hoverinfo: "skip", line: { color: soft, width: 1, dash: "dot" },
    });
  }
  return traces;
}

const MOST_TRUTHS = 6;  // more true paths would hide the estimates

/** The traces of the plan by its `view`; `shown`: the tracks whose estimates are drawn; `window`: their times. */
function planTraces(recording, view, shown, kind, window, trackOf) {
  const { columns, tracks } = recording, traces = view.background(), ink = themed("ink");
  const rows = [], truth = [[], []], ends = [[], [], []];
  for (const k of shown) {
    const inWindow = rowsWithin(columns, tracks[k].first, tracks[k].end, window).filter((row) => columns.v0[row] === columns.v0[row]);
    const limit = FAST ? Infinity : Math.max(50, 3000 / shown.length);
    rows.push(...thinned(inWindow, columns.t, limit));
    if (shown.length > MOST_TRUTHS) continue;
    const path = thinned(inWindow, columns.t, Math.max(400, 12000 / shown.length));
    for (const axis of [0, 1]) {
      truth[axis].push(...broken(path, columns.t, (row) => view.truth(row)[axis]), null);
    }
    if (inWindow.length) {
      for (const [row, mark] of [[inWindow[0], "circle-open"], [inWindow[inWindow.length - 1], "square-open"]]) {
        const [x, y] = view.at(row);
        ends[0].push(x); ends[1].push(y); ends[2].push(mark);
      }
    }
  }
  if (truth[0].some(Number.isFinite)) {
    traces.push({ x: truth[0], y: truth[1], type: "scatter", mode: "lines", name: "truth", hoverinfo: "skip",
                  line: { color: ink, width: 1.2, dash: "dash" } });
  }
  traces.push({
    x: rows.map((row) => view.at(row)[0]), y: rows.map((row) => view.at(row)[1]), customdata: rows, type: MARKS,
    mode: "markers", name: "estimates", hoverinfo: "none", meta: "estimates", showlegend: kind !== "source",
    marker: { size: rows.length > 5000 ? 3.5 : 5, opacity: 0.75, ...markerColours(recording, kind, rows, trackOf) },
  });
  if (kind === "source") traces.push(...sourceLegend(recording));
  traces.push({ x: ends[0], y: ends[1], type: "scatter", mode: "markers", name: "start ○ and end □", hoverinfo: "skip",
                marker: { symbol: ends[2], size: 13, color: ink, line: { width: 2 } } });
  return [...traces, ...view.mounted()];
}

const sourceLegend = (recording) => recording.sources.map((name, k) => ({
  x: [null], y: [null], type: "scatter", mode: "markers", name: escaped(name), marker: { color: lineColour(k), size: 8 },
}));

/** Anchors or stations; those above each other share a label. */
function mountedAt(list, kind, symbol) {
  if (!list.length) return [];
  const extent = [0, 1].map((axis) => Math.max(...list.map((one) => one.at[axis])) - Math.min(...list.map((one) => one.at[axis])));
  const near = Math.max(...extent) / 40, groups = [];
  for (const one of list) {
    const group = groups.find(([first]) => Math.hypot(first.at[0] - one.at[0], first.at[1] - one.at[1]) <= near);
    if (group) group.push(one); else groups.push([one]);
  }
  return [{
    x: groups.map((g) => g[0].at[0]), y: groups.map((g) => g[0].at[1]), type: "scatter", mode: "markers+text", name: kind,
    text: groups.map((g) => escaped(g.map((one) => one.name).sort(naturally).join(", "))), textposition: "bottom center", cliponaxis: false,
    hovertext: groups.map((g) => g.map((one) => `${kind} ${escaped(one.name)}, z ${fixed(one.at[2], 2)} m`).join("<br>")),
    hoverinfo: "text", textfont: { size: 11 }, marker: { symbol, size: 10, color: themed("soft") },
  }];
}

/** Ranges of both axes: rig, truth, and 98 % of the estimates, with a margin. */
function planRanges(recording) {
  const { columns, rig, tracks } = recording;
  return [0, 1].map((axis) => {
    const sure = [...rig.anchors, ...rig.stations].map((one) => one.at[axis]);
    sure.push(...rig.path.map((p) => p[axis]), ...rig.walls.flatMap((w) => [w[axis], w[axis + 2]]));
    for (const track of tracks) {
      const coordinates = [];
      for (let row = track.first; row < track.end; row++) {
        const value = columns[`v${axis}`][row], error = columns[`e${axis}`][row];
        if (Number.isFinite(value)) coordinates.push(value);
        if (Number.isFinite(value - error)) sure.push(value - error);
      }
      coordinates.sort((a, b) => a - b);
      const last = coordinates.length - 1;
      if (last >= 0) sure.push(coordinates[Math.floor(0.01 * last)], coordinates[Math.ceil(0.99 * last)]);
    }
    let low = Infinity, high = -Infinity;
    for (const value of sure) { low = Math.min(low, value); high = Math.max(high, value); }
    if (!(high >= low)) return [-1, 1];
    const margin = Math.max(0.06 * (high - low), 0.25);
    return [low - margin, high + margin];
  });
}

function planLayout(recording) {
  const [x, y] = planRanges(recording), [xFrom, yFrom] = recording.origin;
  return {
    xaxis: { title: { text: fromOrigin("x", xFrom) }, range: x, zeroline: false },
    yaxis: { title: { text: fromOrigin("y", yFrom) }, range: y, zeroline: false, scaleanchor: "x" },
    hovermode: "closest", dragmode: "pan", uirevision: recording.name, margin: { l: 56, r: 12, t: 40, b: 44 },
  };
}
