// Charts of all rows of a recording: residuals by source, map of errors, and those that Python draws.

const QUANTILES = ["lowerfence", "q1", "median", "q3", "upperfence"];

/** Each chart as its title, traces and layout. */
function chartsOf(recording) {
  const charts = [];
  for (const channel of recording.residuals.channels) {
    charts.push(boxChart(channel));
    if (channel.curves.length && channel.sources.length > 1) charts.push(curveChart(channel));
  }
  if (recording.map) charts.push(mapChart(recording));
  return [...charts, ...recording.charts.map(drawnChart)];
}

function boxChart(channel) {
  const kinds = [["estimated", "about the estimates", "#0072b2"], ["true", "about the truth", "#d55e00"]];
  const traces = kinds.filter(([kind]) => channel.boxes[kind]).map(([kind, name, colour]) => {
    const boxes = channel.boxes[kind], there = boxes.map((_, k) => k).filter((k) => boxes[k][1] !== null);
    const trace = { type: "box", name, x: there.map((k) => escaped(channel.sources[k])), marker: { color: colour }, offsetgroup: kind,
                    hoverinfo: "y", mean: there.map((k) => boxes[k][1]) };
    QUANTILES.forEach((quantile, q) => { trace[quantile] = there.map((k) => boxes[k][3 + q]); });
    return trace;
  });
  const named = channel.sources.length > 1 ? ` by ${channel.name === "range" ? "anchor" : "station"}` : "";
  return { title: `Residuals, ${channel.name}${named}`, note: "Boxes: median and half of the readings; whiskers: 90 %.", traces, layout: { boxmode: "group",
                             xaxis: { type: "category" }, yaxis: { title: { text: `measured − predicted (${channel.unit})` } } } };
}

function curveChart(channel) {
  const traces = channel.curves.map((curve) => ({
    type: "scatter", mode: "lines+markers", name: escaped(curve.source), x: curve.x, y: curve.y, customdata: curve.n,
    line: { color: lineColour(channel.sources.indexOf(curve.source)), width: 1.4 }, marker: { size: 5 },
    hovertemplate: `%{y:.3f} ${channel.unit}, %{customdata} readings`,
  }));
  return { title: `Mean residual about the truth, ${channel.name}`, traces, layout: { xaxis: { title: { text: channel.againstName } },
                             yaxis: { title: { text: `measured − true (${channel.unit})` } } } };
}

function mapChart(recording) {
  const { map, rig } = recording, [xFrom, yFrom] = recording.origin;
  const traces = [{
    type: "heatmap", x: map.x, y: map.y, z: map.rmse, customdata: map.count, colorscale: "Viridis", zmin: 0,
    colorbar: { title: { text: "RMSE (m)", side: "right" }, thickness: 12, outlinewidth: 0 }, xgap: 1, ygap: 1,
    hovertemplate: "%{z:.3f} m, %{customdata} rows<extra></extra>",
  }, ...mountedAt(rig.anchors, "anchor", "triangle-up"), ...mountedAt(rig.stations, "station", "square")];
  return { title: `Horizontal RMSE over the floor, cells of ${map.cell} m`, traces, layout: { showlegend: false,
                             xaxis: { title: { text: fromOrigin("x", xFrom) }, zeroline: false },
                             yaxis: { title: { text: fromOrigin("y", yFrom) }, zeroline: false, scaleanchor: "x" } } };
}

/** A chart that comes as traces and layout. */
function drawnChart({ title, data, layout: { title: more, ...layout } }) {
  const margin = { l: 56, r: 12, t: 14 + legendHeight(data, 2), b: 44 };
  return { title: more ? `${title}, ${more}` : title, traces: inTheme(data), layout: { ...layout, margin } };
}
